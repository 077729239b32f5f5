"""The design side: models, LQR, MPC and its explicit law. float64 numpy, no torch."""

from sb3_yann.control.explicit.budget import ExplicitLimitError
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.model.identify import Identified, identify
from sb3_yann.control.model.identify_outputs import IdentifiedOutputs, identify_outputs
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.augmented import offset_free, with_extra
from sb3_yann.control.mpc.coordinates import ThetaLayout
from sb3_yann.control.mpc.groups import (
    DisturbanceBounds,
    LinearCost,
    MixedBounds,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)
from sb3_yann.control.mpc.linear_mpc import LinearMPC
from sb3_yann.control.observer import DisturbanceObserver, StateEstimator
from sb3_yann.control.online import OnlineLaw, OnlineLawWarning

__all__ = [
    "DisturbanceBounds",
    "DisturbanceObserver",
    "ExplicitLimitError",
    "ExplicitSolutionError",
    "Identified",
    "IdentifiedOutputs",
    "LinearCost",
    "LinearMPC",
    "LinearModel",
    "MixedBounds",
    "OnlineLaw",
    "OnlineLawWarning",
    "OutputBounds",
    "ParametricQP",
    "PiecewiseAffine",
    "RateLimits",
    "SoftBounds",
    "StateEstimator",
    "Terminal",
    "ThetaLayout",
    "Tracking",
    "identify",
    "identify_outputs",
    "offset_free",
    "with_extra",
]
