"""Trainings and commissionings that are killed, or meet Ctrl-C, at a random moment."""

from __future__ import annotations

import json
import os
import signal
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from experiments.children import end, fork, let_work
from experiments.faulty_plants import ENV
from sb3_yann import Commissioning, ImprovementGuard, NoActionNoise

TRAIN = 2.0
"""Seconds of a core within which a training is hit."""
PATIENCE = 600.0
"""Seconds after which what goes on, or ends, counts as hung; there may be others on the cores."""
BRIEF = 40
"""Steps of an episode of the plant that is commissioned."""
BATCHES = 2
TOO_SOON, TOO_LATE = "not begun", "it was through"
"""What does not count: nothing had begun, or nothing was left to hit."""


def counted(trial: Callable[[], str], count: int) -> list[str]:
    """Return what so many trials found, without those that hit nothing.

    RuntimeError if most of them hit nothing.
    """
    found: list[str] = []
    left_out: Counter[str] = Counter()
    while len(found) < count:
        outcome = trial()
        if outcome in (TOO_SOON, TOO_LATE):
            left_out[outcome] += 1
        else:
            found.append(outcome)
        if left_out.total() > 10 + 3 * count:
            raise RuntimeError(f"{left_out} of the trials hit nothing, {len(found)} did")
    print("left out:", dict(left_out), flush=True)
    return found


def learner() -> DDPG:
    """Return a model of the reactor that learns soon."""
    return DDPG("YannPolicy", ENV, device="cpu", seed=0, policy_kwargs={"critic_warmup": 50})


def _learn(model: DDPG, steps: int, *callbacks: BaseCallback, **kwargs: Any) -> None:
    """Train under guard; Ctrl-C ends it."""
    guard = ImprovementGuard(ENV, n_starts=3, n_new_starts=3, n_final_starts=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model.learn(steps, callback=[NoActionNoise(), guard, *callbacks], **kwargs)
        except KeyboardInterrupt:
            pass


def _whose(model: DDPG) -> str:
    """Return whether a model holds the policy that its guard accepted last."""
    if not hasattr(model, "guard_state"):
        return TOO_SOON
    saved = [each.clone() for each in model.actor.state_dict().values()]
    model.guard_state.accepted.restore(model.policy)
    kept = model.actor.state_dict().values()
    same = all(torch.equal(*pair) for pair in zip(saved, kept, strict=True))
    return "the accepted policy" if same else "another policy"


def interrupted(rng: np.random.Generator, model: DDPG) -> str:
    """Return what Ctrl-C leaves of guarded training: the accepted policy, or another."""
    with TemporaryDirectory() as name:
        folder = Path(name)

        def learn() -> None:
            _learn(model, 4_000)
            (folder / _whose(model)).touch()

        child = fork(learn)
        let_work(child, rng.uniform(0, TRAIN))
        said = end(child, signal.SIGINT, PATIENCE)
        otherwise = "hangs" if said == "hangs" else TOO_SOON
        return next((each.name for each in folder.iterdir()), otherwise)


class Saved(BaseCallback):
    """Saves the model every few steps, under another name, and renames it."""

    def __init__(self, path: Path, every: int = 50) -> None:
        super().__init__()
        self.path, self.every = path, every

    def _on_step(self) -> bool:
        if self.n_calls % self.every == 0:
            part = self.path.with_name("part.zip")
            self.model.save(part)
            os.replace(part, self.path)
        return True


def killed(rng: np.random.Generator, model: DDPG) -> str:
    """Return whether guarded training goes on from the last save after a kill."""
    with TemporaryDirectory() as name:
        path = Path(name) / "model.zip"
        child = fork(lambda: _learn(model, 4_000, Saved(path)))
        let_work(child, rng.uniform(0, TRAIN))
        end(child, signal.SIGKILL)
        if not path.exists():
            return TOO_SOON

        def go_on() -> None:
            loaded = DDPG.load(path, env=gym.make(ENV), device="cpu")
            before = loaded.num_timesteps
            _learn(loaded, 300, reset_num_timesteps=False)
            whole = loaded.num_timesteps >= before + 300
            (Path(name) / (_whose(loaded) if whole else "it stopped")).touch()

        said = end(fork(go_on), patience=PATIENCE)
        found = {each.name for each in Path(name).iterdir()} - {"model.zip", "part.zip"}
        return f"goes on, {found.pop()}" if said == "done" else f"going on: {said}"


def brief() -> gym.Env[Any, Any]:
    """Return the reactor with short episodes: a commissioning of it takes a second."""
    return gym.wrappers.TimeLimit(gym.make(ENV), BRIEF)


def _commission(model: DDPG, folder: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        Commissioning(model, brief, batch=2, iterations=3, log_path=folder).run(BATCHES)


def _events(folder: Path) -> list[dict[str, Any]]:
    """Return the whole events of a record."""
    path = folder / "commissioning.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    found = []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:
            pass
    return found


def commissioned(model: DDPG) -> tuple[float, list[Any]]:
    """Return how many seconds of a core an unhurt commissioning takes, and its batches.

    The first one, which may compile what others find on the disk, is not timed.
    """
    for _ in range(2):
        with TemporaryDirectory() as name:
            before = os.times()
            end(fork(lambda at=Path(name): _commission(model, at)), patience=PATIENCE)
            after = os.times()
            used = after.children_user - before.children_user
            used += after.children_system - before.children_system
            found = used, _batches(_events(Path(name)))
    return found


def _batches(events: list[dict[str, Any]]) -> list[Any]:
    """Return what was decided, and upon which costs."""
    return [
        (each["verdict"], each["cost"], each["mpc"]) for each in events if each["event"] == "batch"
    ]


def cut_off(rng: np.random.Generator, model: DDPG, seconds: float, wanted: list[Any]) -> str:
    """Return whether a commissioning goes on after a kill, to the batches that are wanted."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        child = fork(lambda: _commission(model, folder))
        let_work(child, rng.uniform(0, seconds))
        if end(child, signal.SIGKILL) == "done":
            return TOO_LATE
        events = _events(folder)
        if not events:
            return TOO_SOON
        MOMENTS[_moment(events[-1])] += 1
        said = end(fork(lambda: _commission(model, folder)), patience=PATIENCE)
        if said != "done":
            return f"going on: {said}"
        same = _batches(_events(folder)) == wanted
        return "goes on to its end" if same else "goes on to another end"


MOMENTS: Counter[str] = Counter()
"""What the commissionings were at that were killed."""


def _moment(last: dict[str, Any]) -> str:
    """Return what a commissioning is at after its last event."""
    if last["event"] == "episode":
        return "learning, or between two episodes"
    return "an episode" if last["event"] == "start" else "between two batches"
