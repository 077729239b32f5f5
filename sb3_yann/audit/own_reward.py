"""Whether an env has a reward of its own, which counts nothing where a stage cost does."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.finding import CostMismatchWarning
from sb3_yann.control import LinearMPC
from sb3_yann.rollout import Trajectories
from sb3_yann.wrappers import SetPoint

Mask = NDArray[np.bool_]
EXPLAINED = 0.95
"""Share of the rewards' variance from which on they are taken for minus the stage cost."""
FEWEST = 10
"""Steps that must be seen."""


def below_set_points(env: gym.Env[Any, Any]) -> bool:
    """Tell whether a wrapper draws set-points, of which the env's reward knows nothing."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, SetPoint):
            return True
        env = env.env
    return False


def warn_of_own_reward(problem: LinearMPC, played: Trajectories, stacklevel: int) -> None:
    """Warn where rewards are not minus the stage cost, times a constant and up to one.

    The constant may be each episode's own: it ranks no controllers. The cost may be that of the
    state before the step or after it. Rewards that are all zero are none.

    Parameters
    ----------
    problem : LinearMPC
        Whose stage cost counts.
    played : Trajectories
        Of thetas, inputs and rewards.
    stacklevel : int
        Of the warning.
    """
    thetas, inputs, rewards = played.padded()
    costs = [problem.deviations.stage_cost(at, inputs) for at in (thetas[:-1], thetas[1:])]
    known: Mask = np.asarray(np.all(np.isfinite([rewards, *costs]), axis=0), dtype=np.bool_)
    if np.count_nonzero(known) < FEWEST or not np.any(rewards[known]):
        return
    share = max(_explained(-cost, rewards, known) for cost in costs)
    if share < EXPLAINED:
        warnings.warn(
            f"The env has a reward of its own, and it is ignored: the MPC's stage cost explains "
            f"{100 * share:.0f} % of it over {np.count_nonzero(known)} steps of the MPC. What "
            "counts here is the MPC's stage cost. If the reward is what you want, state it in Q "
            "and R of the MPC, or learn under an ImprovementGuard or a Commissioning, which go by "
            "the reward; else wrap the env in sb3_yann.wrappers.StageCost(env, mpc).",
            CostMismatchWarning,
            stacklevel=stacklevel,
        )


def _explained(gain: Array, rewards: Array, known: Mask) -> float:
    """Return the share of the rewards' variance within episodes that a gain explains, 0 to 1.

    It is 1 where the gain does not vary, which says nothing, and 0 where rewards fall as it rises.
    """
    x, y = (_centered(each, known) for each in (gain, rewards))
    size = np.sqrt(np.sum(x**2) * np.sum(y**2))
    if np.abs(x).max() <= 1e-9 * np.abs(gain[known]).max():
        return 1.0
    correlation = float(x @ y / size) if size > 0 else 0.0
    return max(correlation, 0.0) ** 2


def _centered(values: Array, known: Mask) -> Array:
    """Return the known values (steps,) less the mean of their episodes, the columns."""
    kept = np.where(known, values, 0.0)
    mean = kept.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.asarray((values - mean)[known])
