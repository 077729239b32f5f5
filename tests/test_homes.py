"""A law is solved and a policy learns where there is no home to keep anything in."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

WORK = """
import torch
torch.set_num_threads(1)
from stable_baselines3 import DDPG
from sb3_yann import ImprovementGuard, NoActionNoise
from sb3_yann.evaluation.plots import plot_regions
from sb3_yann_envs import problems
plot_regions(problems.clipped_pendulum()).figure.savefig("law.png")
options = {"critic_warmup": 50}
model = DDPG("YannPolicy", "CSTR-v0", device="cpu", seed=0, policy_kwargs=options)
guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_new_starts=2, n_final_starts=2)
model.learn(120, callback=[NoActionNoise(), guard])
print(model.num_timesteps)
"""
BARE = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
"""Root may write anywhere; without its capabilities it may not."""


def home(kind: str, folder: Path) -> Path:
    """Return a home that cannot be made, or one that cannot be written to."""
    if kind == "missing":
        (folder / "file").touch()
        return folder / "file" / "home"
    (folder / "home").mkdir(mode=0o555)
    return folder / "home"


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a home of its own kind")
@pytest.mark.parametrize("kind", ["missing", pytest.param("read-only", marks=pytest.mark.nightly)])
def test_it_works_without_a_home(kind: str, tmp_path: Path) -> None:
    bare = BARE if os.geteuid() == 0 else []
    if bare and not shutil.which(bare[0]):
        pytest.skip("root may write anywhere")
    own = home(kind, tmp_path)
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "MPLC"))}
    work = tmp_path / "work"
    work.mkdir()
    ran = subprocess.run(
        [*bare, sys.executable, "-c", WORK],
        cwd=work, env={**kept, "HOME": str(own), "MPLBACKEND": "Agg"},
        capture_output=True, text=True,
    )  # fmt: skip
    assert (ran.returncode, ran.stdout) == (0, "120\n"), ran.stderr
    assert (work / "law.png").exists()
    assert not own.exists() or list(own.iterdir()) == []
