"""Uses what an installed sb3-yann promises, with nothing of its sources around.

python tests/support/installed.py
"""

from importlib import import_module
from importlib.resources import files

import gymnasium as gym
from stable_baselines3 import DDPG

import sb3_yann
import sb3_yann_envs

ROOMS = "audit control deployment evaluation guard networks policy twin wrappers commissioning"


def main() -> None:
    """Load every public name, make both envs, train a policy and read its settings."""
    rooms = [import_module(f"sb3_yann.{room}") for room in ROOMS.split()]
    for package in (sb3_yann, sb3_yann_envs, *rooms):
        assert "site-packages" in package.__file__, f"{package.__file__} is not what was installed"
        for name in getattr(package, "__all__", ()):
            getattr(package, name)
    for env_id in ("CSTR-v0", "ClippedPendulum-v0"):
        env = gym.make(env_id)
        env.reset(seed=0)
        env.step(env.action_space.sample())
    model = DDPG("YannPolicy", "CSTR-v0", device="cpu", policy_kwargs={"critic_warmup": 50})
    guard = sb3_yann.ImprovementGuard("CSTR-v0", n_eval_episodes=3, n_new_starts=3)
    model.learn(500, callback=[sb3_yann.NoActionNoise(), guard])
    for algorithm in ("ddpg", "td3"):
        text = (files("sb3_yann.hyperparams") / f"{algorithm}.yml").read_text(encoding="utf-8")
        assert "\nCSTR-v0:" in text and "\nClippedPendulum-v0:" in text
    print("all is there")


if __name__ == "__main__":
    main()
