"""The design side: models, LQR, MPC and its explicit law. float64 numpy, no torch."""

from sb3_yann.control.explicit import ExplicitLimitError, ExplicitSolutionError, ParametricQP
from sb3_yann.control.identification import Identified, identify
from sb3_yann.control.linear_model import LinearModel
from sb3_yann.control.mpc import LinearMPC
from sb3_yann.control.observer import DisturbanceObserver
from sb3_yann.control.parameters import Parameters
from sb3_yann.control.piecewise_affine import PiecewiseAffine

__all__ = [
    "DisturbanceObserver",
    "ExplicitLimitError",
    "ExplicitSolutionError",
    "Identified",
    "LinearMPC",
    "LinearModel",
    "Parameters",
    "ParametricQP",
    "PiecewiseAffine",
    "identify",
]
