"""Gymnasium environments of the YANN-RL case studies (Braniff & Tian).

Importing the package registers ``CSTR-v0`` and ``ClippedPendulum-v0``. It needs neither PyTorch nor
Stable-Baselines3, so the environments can be used with any agent::

    import gymnasium
    import sb3_yann_envs

    env = gymnasium.make("CSTR-v0")
"""

from __future__ import annotations

import gymnasium

from sb3_yann_envs.action_repeat import ActionRepeat
from sb3_yann_envs.spaces import ProblemBox

__all__ = ["ActionRepeat", "ProblemBox", "register_envs"]

_ENTRY_POINTS: dict[str, tuple[str, str, int]] = {
    "CSTR-v0": ("sb3_yann_envs.cstr:CSTREnv", "sb3_yann_envs.vector:CSTRVectorEnv", 400),
    "ClippedPendulum-v0": (
        "sb3_yann_envs.clipped_pendulum:ClippedPendulumEnv",
        "sb3_yann_envs.vector:ClippedPendulumVectorEnv",
        200,
    ),
}


def register_envs() -> None:
    """Make sure that Gymnasium knows every environment of this package.

    Ids that are already registered are left as they are, so the call can be repeated, and a user's
    own registration under the same id wins.

    Examples
    --------
    >>> register_envs()
    >>> gymnasium.spec("CSTR-v0").max_episode_steps
    400
    """
    for env_id, (entry_point, vector_entry_point, max_episode_steps) in _ENTRY_POINTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                id=env_id,
                entry_point=entry_point,
                vector_entry_point=vector_entry_point,
                max_episode_steps=max_episode_steps,
            )


register_envs()
