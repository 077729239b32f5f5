"""The Stable-Baselines3 policy that starts as a linear MPC."""

from sb3_yann._validation import NonFiniteWarning
from sb3_yann.policy.actor_critic import CriticOptions, YannActor, YannCritic
from sb3_yann.policy.checkpoint import retarget
from sb3_yann.policy.checks import register_problem
from sb3_yann.policy.exploring import YannPPOPolicy, YannSACPolicy
from sb3_yann.policy.observations import AffineObservation
from sb3_yann.policy.policies import YannPolicy

__all__ = [
    "AffineObservation",
    "CriticOptions",
    "NonFiniteWarning",
    "YannActor",
    "YannCritic",
    "YannPPOPolicy",
    "YannPolicy",
    "YannSACPolicy",
    "register_problem",
    "retarget",
]
