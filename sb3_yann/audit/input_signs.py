"""Whether the inputs of an env act in the direction that the model says."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of
from sb3_yann.rollout import Trajectories

STARTS = 5
"""Starts from which each input is pushed; it must act against the model from all of them."""
LEAST = 1e-3
"""Of the states' standard deviation: an effect that is smaller may be rounding."""


def warn_of_signs(
    problem: LinearMPC,
    env: gym.Env[Any, Any],
    seeds: Sequence[int],
    played: Trajectories,
    *,
    theta: Callable[[Array], Array] = np.asarray,
    inputs: Callable[[Array], Array] = np.asarray,
    stacklevel: int,
) -> None:
    """Warn where an input moves the states against the model, in the first step of some starts.

    Two steps from one start differ by that input alone: neither noise that the seed repeats, nor
    what is not linear in the states, gets in. It costs a step of the env for each input and start.

    Parameters
    ----------
    problem : LinearMPC
        Whose model says what an input does.
    env : gymnasium.Env
        Repeats an episode from its seed.
    seeds, played : sequence of int, and Trajectories
        Starts, and the episodes of the MPC from there.
    theta, inputs : callable
        From what the env shows (steps, k) to theta, and from actions (steps, m) to inputs.
    stacklevel : int
        Of the warning.
    """
    names, B, states = labels_of(problem.model)[1], problem.model.B, problem.layout.state
    shown = np.concatenate([theta(each)[:, states] for each in played.observations])
    spread = np.std(shown[np.isfinite(shown).all(axis=1)], axis=0)
    weight = np.divide(1, spread, out=np.zeros_like(spread), where=spread > 0)
    starts = [i for i in range(len(seeds)) if len(played.actions[i])][:STARTS]
    for j, name in enumerate(names):
        gains = []
        for i in starts:
            action = played.actions[i][0]
            pushed = _push(env, action, j)
            try:
                env.reset(seed=seeds[i])
                after = np.array([played.observations[i][1], env.step(pushed)[0]])
            except Exception:  # of a brittle simulator: what it says under the MPC counts
                return
            effect = weight * np.diff(theta(after)[:, states], axis=0)[0]
            expected = weight * B[:, j] * np.diff(inputs(np.array([action, pushed])), axis=0)[0, j]
            size = float(expected @ expected)
            if size > 0 and np.linalg.norm(effect) > LEAST:
                gains.append(float(effect @ expected) / size)
        if len(gains) == len(starts) > 0 and max(gains) < 0:
            warnings.warn(
                f"{name} moves the env against the sign of the model's B: {np.median(gains):.2g} "
                f"times as far in a step, from {len(gains)} starts. The MPC steers the wrong way. "
                "Look at the sign and the order of the actions, and at B.",
                stacklevel=stacklevel,
            )


def _push(env: gym.Env[Any, Any], action: Array, j: int) -> Array:
    """Return an action whose entry j is half the way to the bound that is farther away."""
    space: Any = env.action_space
    low, high = np.clip([space.low[j], space.high[j]], action[j] - 1e3, action[j] + 1e3)
    far = high if high - action[j] > action[j] - low else low
    pushed = np.array(action, dtype=space.dtype)
    pushed[j] = (action[j] + far) / 2
    return pushed
