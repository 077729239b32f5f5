"""One action for several steps of an env."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium
from gymnasium.core import ActType, ObsType


class ActionRepeat(
    gymnasium.Wrapper[ObsType, ActType, ObsType, ActType], gymnasium.utils.RecordConstructorArgs
):
    """Holds each action for ``k`` steps of the env, and adds up their rewards.

    A policy then decides every ``k * dt``, where ``dt`` is the sampling time of the env: the model
    of its MPC must have that sampling time, e.g. ``LinearModel.from_continuous(A, B, k * dt)``. The
    reward is about that of weights ``k * Q`` and ``k * R``, or of the critic's ``reward_scale=k``;
    :class:`sb3_yann.CostAudit` measures how well they describe it.

    ``info`` is that of the last step, but ``info["violation"]`` is true if it was true in any
    (`gymnasium.wrappers.RepeatAction` loses that). An episode that ends, ends at once. A time limit
    below this wrapper counts steps of the env, one above it counts decisions.

    Parameters
    ----------
    env : gymnasium.Env
    k : int
        Steps for each action, at least 1.

    Raises
    ------
    ValueError
        If ``k`` is no whole number of at least 1.

    Examples
    --------
    >>> env = ActionRepeat(gymnasium.make("CSTR-v0"), 5)
    >>> _ = env.reset(seed=0)
    >>> round(float(env.step(env.action_space.low)[1]), 3)  # five steps
    -28.025
    """

    def __init__(self, env: gymnasium.Env[ObsType, ActType], k: int) -> None:
        if isinstance(k, bool) or not isinstance(k, int) or k < 1:
            raise ValueError(f"k = {k!r} must be a whole number of steps, at least 1.")
        gymnasium.utils.RecordConstructorArgs.__init__(self, k=k)
        gymnasium.Wrapper.__init__(self, env)
        self.k = k

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take up to k steps; the reward is their sum."""
        total = 0.0
        violation = False
        for _ in range(self.k):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            violation = violation or bool(info.get("violation", False))
            if terminated or truncated:
                break
        if violation:
            info = {**info, "violation": True}
        return observation, total, terminated, truncated, info
