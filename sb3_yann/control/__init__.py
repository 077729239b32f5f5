"""The design side: models, LQR, MPC and its explicit law. float64 numpy, no torch."""

from sb3_yann.control.explicit.solve import ExplicitLimitError, ExplicitSolutionError, ParametricQP
from sb3_yann.control.law.piecewise_affine import PiecewiseAffine
from sb3_yann.control.model.identify import Identified, identify
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.mpc.linear_mpc import LinearMPC
from sb3_yann.control.mpc.theta_layout import ThetaLayout
from sb3_yann.control.observer import DisturbanceObserver

__all__ = [
    "DisturbanceObserver",
    "ExplicitLimitError",
    "ExplicitSolutionError",
    "Identified",
    "LinearMPC",
    "LinearModel",
    "ParametricQP",
    "PiecewiseAffine",
    "ThetaLayout",
    "identify",
]
