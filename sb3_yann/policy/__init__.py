"""The Stable-Baselines3 policy that starts as a linear MPC."""

from sb3_yann._validation import NonFiniteWarning
from sb3_yann.policy.actor_critic import YannActor, YannCritic
from sb3_yann.policy.critic_options import CriticOptions
from sb3_yann.policy.observations import AffineObservation
from sb3_yann.policy.policies import YannPolicy
from sb3_yann.policy.problem_registry import register_problem

__all__ = [
    "AffineObservation",
    "CriticOptions",
    "NonFiniteWarning",
    "YannActor",
    "YannCritic",
    "YannPolicy",
    "register_problem",
]
