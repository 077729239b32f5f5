"""Episodes out of a replay buffer of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.twin.log import SHORTEST

LOST_STATISTICS = (
    "The model takes observations as a VecNormalize shows them, and its env has none: Stable-"
    "Baselines3 saves its statistics apart. Keep them with venv.save(path), and load the model "
    "with env=VecNormalize.load(path, venv)."
)


def normalization_of(model: Any) -> Any:
    """Return a model's VecNormalize, None where it does without.

    Raises
    ------
    ValueError
        If the model has been trained with one that is lost.
    """
    normalize = model.get_vec_normalize_env()
    if normalize is None and getattr(model, "sees_normalized", False):
        raise ValueError(LOST_STATISTICS)
    return normalize


def episodes_of(model: Any) -> list[tuple[Array, Array]]:
    """Return the episodes (thetas, actions) that a model's replay buffer holds, whole or in part.

    They are in plant units. Those of a simulator are left out.

    Raises
    ------
    TypeError, ValueError
        If the model has no YannPolicy, or its buffer holds no episode of five steps.
    """
    policy: Any = getattr(model, "policy", None)
    problem = getattr(policy, "problem", None)
    if problem is None:
        raise TypeError(f"model must have a YannPolicy, its policy is {type(policy).__name__}.")
    buffer = model.replay_buffer
    if buffer.optimize_memory_usage:
        raise ValueError(
            "optimize_memory_usage=True keeps no last states of episodes. Build the model without "
            "it, or pass the episodes to PlantTwin.fit."
        )
    order = np.arange(buffer.size())
    if buffer.full:  # the oldest row is the one that comes next
        order = np.roll(order, -buffer.pos)
    normalize = normalization_of(model)

    def theta(observations: Any) -> Array:
        seen = observations if normalize is None else normalize.normalize_obs(observations)
        found: Array = problem.units.to_plant(policy.theta(seen).double().cpu().numpy())
        return found

    found = []
    for env in range(buffer.n_envs):
        now, after = buffer.observations[order, env], buffer.next_observations[order, env]
        scaled = buffer.actions[order, env].astype(np.float64)
        u = problem.u_min + (scaled + 1) / 2 * (problem.u_max - problem.u_min)
        ends = buffer.dones[order, env].astype(bool)
        same = np.all(now[1:] == after[:-1], axis=tuple(range(1, now.ndim)))
        ends[:-1] |= ~same
        simulated = vars(buffer).get("simulated")
        other = np.zeros(len(order), bool) if simulated is None else simulated[order, env]
        begin = 0
        for end in [*np.flatnonzero(ends), len(order) - 1]:
            rows = slice(begin, end + 1)
            if end + 1 - begin >= SHORTEST and not other[rows].any():
                thetas = np.concatenate([theta(now[rows]), theta(after[end : end + 1])])
                found.append((thetas, u[rows]))
            begin = end + 1
    if not found:
        raise ValueError(
            f"The replay buffer holds {buffer.size()} rows and no episode of {SHORTEST} steps. "
            "Let the model run on the plant first: model.learn(steps, callback=NoActionNoise())."
        )
    return found
