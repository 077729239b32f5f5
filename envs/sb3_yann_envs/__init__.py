"""Gymnasium environments of the YANN-RL case studies (Braniff & Tian).

Importing the package registers ``CSTR-v0`` and ``ClippedPendulum-v0``, for any agent: it needs
neither PyTorch nor Stable-Baselines3.
"""

from __future__ import annotations

import gymnasium

from sb3_yann_envs.action_repeat import ActionRepeat
from sb3_yann_envs.spaces import ProblemBox

__all__ = ["ActionRepeat", "ProblemBox", "register_envs"]

_ENVS = {
    "CSTR-v0": ("cstr", "CSTR", 400),
    "ClippedPendulum-v0": ("clipped_pendulum", "ClippedPendulum", 200),
}


def register_envs() -> None:
    """Make sure that Gymnasium knows every environment of this package.

    A user's own registration under the same id wins.

    Examples
    --------
    >>> register_envs()
    >>> gymnasium.spec("CSTR-v0").max_episode_steps
    400
    """
    for env_id, (module, name, max_episode_steps) in _ENVS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                id=env_id,
                entry_point=f"sb3_yann_envs.{module}:{name}Env",
                vector_entry_point=f"sb3_yann_envs.{module}:{name}VectorEnv",
                max_episode_steps=max_episode_steps,
            )


register_envs()
