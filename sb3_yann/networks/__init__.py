"""Networks that start as something known, exactly, and are trainable. torch, no SB3."""

from sb3_yann.networks.paper_yann import PaperYann
from sb3_yann.networks.value import (
    AfterstateValue,
    LinearPrediction,
    QuadraticStateActionValue,
    Ranges,
)
from sb3_yann.networks.yann import SharedYannLayer, YannLayer
from sb3_yann.networks.zero_output import RowAdam, ZeroOutputNetwork

__all__ = [
    "AfterstateValue",
    "LinearPrediction",
    "PaperYann",
    "QuadraticStateActionValue",
    "Ranges",
    "RowAdam",
    "SharedYannLayer",
    "YannLayer",
    "ZeroOutputNetwork",
]
