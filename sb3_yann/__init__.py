"""Reinforcement learning that starts as a linear MPC: a Stable-Baselines3 plugin.

Importing registers the environments ``CSTR-v0`` and ``ClippedPendulum-v0`` with Gymnasium and the
policy alias ``"YannPolicy"`` with TD3 and DDPG.
"""

import sb3_yann_envs
from sb3_yann._finite import NonFiniteWarning
from sb3_yann.actor_critic import YannActor, YannCritic
from sb3_yann.audit import CostAudit, CostFinding, CostMismatchError, CostMismatchWarning
from sb3_yann.callbacks import ControlDiagnostics, NoActionNoise
from sb3_yann.control import (
    DisturbanceObserver,
    ExplicitLimitError,
    ExplicitSolutionError,
    Identified,
    LinearModel,
    LinearMPC,
    PiecewiseAffine,
    identify,
)
from sb3_yann.guard import Decision, ImprovementGuard, restore_accepted
from sb3_yann.observations import AffineObservation
from sb3_yann.policies import YannPolicy
from sb3_yann.problems import register_problem
from sb3_yann_envs import ActionRepeat

__version__ = "0.1.0"

__all__ = [
    "ActionRepeat",
    "AffineObservation",
    "ControlDiagnostics",
    "CostAudit",
    "CostFinding",
    "CostMismatchError",
    "CostMismatchWarning",
    "Decision",
    "DisturbanceObserver",
    "ExplicitLimitError",
    "ExplicitSolutionError",
    "Identified",
    "ImprovementGuard",
    "LinearMPC",
    "LinearModel",
    "NoActionNoise",
    "NonFiniteWarning",
    "PiecewiseAffine",
    "YannActor",
    "YannCritic",
    "YannPolicy",
    "identify",
    "register_problem",
    "restore_accepted",
]

sb3_yann_envs.register_envs()
