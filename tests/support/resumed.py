"""Trainings that stop at a checkpoint and go on from there, to be compared bit for bit.

Stable-Baselines3 saves neither random states nor the env. So at the checkpoint all random
generators are seeded and the envs are reset, in the run that goes on as in the one that never
stopped. It lies between two steps: callbacks see a step before its transition is stored and learnt
from.
"""

import dataclasses
import os
import sys
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from guard_samples import STEPS, Slide, bits, buffer_bits, build, make_guard, train
from sb3_yann import NoActionNoise


class Checkpoint(BaseCallback):
    """Saves the model where a folder is given; then seeds what the model draws from."""

    def __init__(self, at: int, folder: Path | None = None) -> None:
        super().__init__()
        self.at = at
        self.folder = folder

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps != self.at:
            return
        if self.folder is not None:
            self.model.save(self.folder / "model")
            self.model.save_replay_buffer(self.folder / "buffer")
        set_random_seed(5)
        env = self.model.get_env()
        env.seed(7)
        self.model._last_obs = env.reset()

    def _on_step(self) -> bool:
        return True


def loaded(folder: Path, env: Any, algorithm: Any = DDPG) -> Any:
    """Return the model of a checkpoint with its buffer."""
    model = algorithm.load(folder / "model", env=env, device="cpu")
    model.load_replay_buffer(folder / "buffer")
    return model


def envs(n: int, kind: Any = Slide) -> DummyVecEnv:
    return DummyVecEnv([lambda: Monitor(kind())] * n)


def all_bits(value: Any) -> Any:
    """Return what compares bit for bit, of dataclasses and numbers that are NaN as well."""
    if dataclasses.is_dataclass(value):
        compared = [each.name for each in dataclasses.fields(value) if each.compare]
        return {name: all_bits(getattr(value, name)) for name in compared}
    if isinstance(value, dict):
        return {str(key): all_bits(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [all_bits(each) for each in value]
    return repr(value) if isinstance(value, float) else bits(value)


def model_bits(model: Any) -> dict[str, Any]:
    """Return all that a training has made, that of our callbacks included."""
    policy = model.policy
    parts = {
        "policy": policy.state_dict(),
        "optimizers": [each.optimizer.state_dict() for each in (policy.actor, policy.critic)],
        "counts": [model.num_timesteps, model._n_updates, model._episode_num],
        "guard": getattr(model, "guard_state", None),
    }
    return {**all_bits(parts), "buffer": buffer_bits(model)}


guard_in_simulator = partial(make_guard, n_new_starts=3, n_final_starts=5, patience=2)
LENGTH = 20 * STEPS


HALFWAY = LENGTH // 2


def fresh_trainings() -> None:
    """Train anew, and from a checkpoint where there is one, with 1 and 4 envs; print digests.

    In a process of its own, with a folder and one for the machine code of networks as arguments.
    The law and the code that finds it have been read before.
    """
    folder = Path(sys.argv[1])
    os.environ["NUMBA_CACHE_DIR"] = sys.argv[2]
    numba.core.config.reload_config()
    for n in (1, 4):
        part = folder / str(n)
        record = folder / "guard.csv"
        resumes = part.exists()
        part.mkdir(parents=True, exist_ok=True)
        model = build(env=envs(n))
        guard = guard_in_simulator(log_path=record)
        train(model, LENGTH, guard, Checkpoint(HALFWAY, None if resumes else part))
        print("anew", n, len(guard.decisions), _digest(model_bits(model), record.read_bytes()))
        if resumes:
            model = loaded(part, envs(n))
            go_on(model, LENGTH - HALFWAY, guard_in_simulator(log_path=record))
            print("resumed", n, _digest(model_bits(model), record.read_bytes()))
        record.unlink()
    model = DDPG("YannPolicy", "CSTR-v0", seed=0, device="cpu", learning_starts=10)
    print("anew", "CSTR-v0", _digest(model_bits(model.learn(200, callback=NoActionNoise()))))


def go_on(model: Any, steps: int, *callbacks: BaseCallback) -> None:
    """Train a model that was loaded, from the step of its checkpoint on."""
    at = Checkpoint(model.num_timesteps)
    train(model, steps, *callbacks, at, reset_num_timesteps=False)


def _digest(*parts: Any) -> str:
    return sha256(repr(parts).encode()).hexdigest()
