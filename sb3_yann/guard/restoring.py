"""Putting the accepted policy in the place of a candidate."""

from __future__ import annotations

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann.guard.state import GuardState
from sb3_yann.policy.policies import YannPolicy


def restore_accepted(model: BaseAlgorithm) -> None:
    """Make the policy that a guard accepted last the model's, in training or after a load.

    For what `learn` does at its end and an exception leaves undone, and for a model that was saved
    in the midst of training.

    Raises
    ------
    ValueError
        If no guard has been at work on the model.
    """
    state, policy = getattr(model, "guard_state", None), model.policy
    if not isinstance(state, GuardState) or not isinstance(policy, YannPolicy):
        raise ValueError(f"No ImprovementGuard has been at work on this {type(model).__name__}.")
    state.accepted.restore(policy)
    policy.actor_step = 1.0
