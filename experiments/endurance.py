"""A million steps under guard and in commissioning: `python -m experiments.endurance`, an hour.

Memory, open files, threads and speed are taken twenty times on the way; what grows is a leak. Its
tables go into docs/faults.md.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import psutil
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from experiments.markdown import table
from experiments.summary import quote
from sb3_yann import Commissioning, ImprovementGuard, NoActionNoise

ENV, EPISODE = "CSTR-v0", 400
SAMPLES = 20
HEAD = ("steps", "memory, MB", "open files", "threads", "steps a second")


@dataclass
class Samples:
    """What a process holds after so many steps, and how fast the last ones were."""

    total: int
    rows: list[tuple[int, float, int, int, float]] = field(default_factory=list)
    process: psutil.Process = field(default_factory=psutil.Process)
    began: float = field(default_factory=time.perf_counter)

    def look(self, steps: int) -> None:
        """Take a sample where a twentieth of the steps has passed since the last one."""
        last = self.rows[-1][0] if self.rows else 0
        if steps - last < self.total // SAMPLES:
            return
        now, of = time.perf_counter(), self.process
        speed = (steps - last) / (now - self.began)
        held = of.memory_info().rss / 1e6
        self.rows.append((steps, held, of.num_fds(), of.num_threads(), speed))
        self.began = now
        print(*self.rows[-1], flush=True)

    def text(self) -> str:
        """Return each other sample as a table."""
        chosen = self.rows[1::2] if len(self.rows) > 10 else self.rows
        cells = [
            (f"{steps:,}", f"{memory:.0f}", f"{files}", f"{threads}", f"{speed:,.0f}")
            for steps, memory, files, threads, speed in chosen
        ]
        return table(HEAD, cells, texts=0)


class _Look(BaseCallback):
    def __init__(self, samples: Samples) -> None:
        super().__init__()
        self.samples = samples

    def _on_step(self) -> bool:
        self.samples.look(self.num_timesteps)
        return True


class _Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Takes samples as the steps of a plant pass."""

    def __init__(self, env: gym.Env[Any, Any], samples: Samples) -> None:
        super().__init__(env)
        self.samples, self.steps = samples, 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Count the step."""
        self.steps += 1
        self.samples.look(self.steps)
        return self.env.step(action)


def guarded(steps: int, folder: Path) -> Samples:
    """Train under guard; an update for each sixteenth step, a trial after each tenth episode."""
    samples = Samples(steps)
    model = DDPG(
        "YannPolicy", ENV, device="cpu", seed=0, train_freq=16, tau=0.02, buffer_size=20_000
    )
    guard = ImprovementGuard(ENV, n_starts=20, eval_every=10, log_path=folder / "guard.csv")
    model.learn(steps, callback=[NoActionNoise(), guard, _Look(samples)])
    return samples


def commissioned(steps: int, folder: Path) -> Samples:
    """Put a policy to work on the plant: one long batch of the MPC, then one of the policy."""
    samples = Samples(steps)
    model = DDPG("YannPolicy", ENV, device="cpu", seed=0)
    plant = _Counted(gym.make(ENV), samples)
    batch = max(2, steps // EPISODE // 3)
    run = Commissioning(model, plant, batch=batch, log_path=folder / "record", iterations=20)
    run.run(batches=2)
    print(run.report())
    return samples


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both, print the tables and quote them."""
    parser = argparse.ArgumentParser(prog="python -m experiments.endurance", description=__doc__)
    parser.add_argument("--steps", type=int, default=800_000, help="under guard")
    parser.add_argument("--plant-steps", type=int, default=200_000, help="in commissioning")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    with TemporaryDirectory() as name:
        parts = [
            f"{what}:\n\n{found.text()}"
            for what, found in (
                ("Training under guard", guarded(options.steps, Path(name))),
                ("`Commissioning`", commissioned(options.plant_steps, Path(name))),
            )
        ]
    text, page = "\n\n".join(parts), options.report / "faults.md"
    print(text)
    if quote(text, page, "<!-- long: begin -->\n", "<!-- long: end -->"):
        print(f"Written: {page}")


if __name__ == "__main__":
    main()
