"""Networks that start as something known, exactly, and are trainable. torch, no SB3."""

from sb3_yann.networks.paper_yann import PaperYann
from sb3_yann.networks.prediction import LinearPrediction
from sb3_yann.networks.row_adam import RowAdam
from sb3_yann.networks.shared_yann import SharedYannLayer
from sb3_yann.networks.value import AfterstateValue, QuadraticStateActionValue, Ranges
from sb3_yann.networks.yann import YannLayer
from sb3_yann.networks.zero_output import ZeroOutputNetwork

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
