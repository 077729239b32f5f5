"""Disturbances that an observer estimates: where the observer is, and what a log shows of it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import ROUNDED

EXPLAINED = 1e-3
"""An estimate's moves follow the model's errors but for so much of their squares."""


class EstimatedDisturbanceWarning(UserWarning):
    """The disturbances of a log move as an observer's estimate does, and no observer is given."""


def observer_of(env: Any) -> StateEstimator | None:
    """Return the observer among the wrappers of an env or of a VecEnv, None where there is none.

    An id, a class or a function that makes an env has none.

    Examples
    --------
    >>> import gymnasium as gym
    >>> observer_of(gym.make("CSTR-v0")) is None
    True
    """
    found = None
    if isinstance(env, VecEnv):
        found = env.get_attr("observer", 0)[0] if env.has_attr("observer") else None
    elif isinstance(env, gym.Env) and env.has_wrapper_attr("observer"):
        found = env.get_wrapper_attr("observer")
    return found if isinstance(found, StateEstimator) else None


def warn_of_estimates(problem: LinearMPC, episodes: Sequence[Episode]) -> None:
    """Warn where the disturbances of a log move as those of an observer.

    An observer moves its estimate by a fixed matrix times what the model does not predict.
    """
    parts, inside = problem.layout, (problem.deviations.theta_min, problem.deviations.theta_max)
    if not parts.n_disturbances:
        return
    d_min, d_max = (each[parts.disturbance] for each in inside)
    room, errors, moves = ROUNDED * (d_max - d_min), [], []
    for each in episodes:
        d = each.thetas[:, parts.disturbance]
        free = np.all((d > d_min + room) & (d < d_max - room), axis=1)
        free = free[1:] & free[:-1]
        left = each.thetas[1:] - problem.deviations.predict(each.thetas[:-1], each.actions)
        errors.append(left[free, parts.state])
        moves.append(np.diff(d, axis=0)[free])
    e, moved = np.concatenate(errors), np.concatenate(moves)
    half = problem.theta_half[parts.disturbance]
    if len(e) <= 2 * parts.n_states or not np.any(np.std(moved, axis=0) > 1e-6 * half):
        return
    left = moved - e @ np.linalg.lstsq(e, moved, rcond=None)[0]
    if np.sum((left / half) ** 2) <= EXPLAINED * np.sum((moved / half) ** 2):
        warnings.warn(
            "The disturbances of the log follow the model's errors, as an observer's estimate "
            "does. A twin takes them for measured ones, which the policy does not move. Pass "
            "observer=, the one of ObserveDisturbance.",
            EstimatedDisturbanceWarning,
            stacklevel=4,
        )
