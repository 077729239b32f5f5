"""A long training under the guard holds no more memory, files or threads as it goes on.

``LONG_STEPS`` says how many steps it takes (40,000 by default)."""

import os

import numpy as np
import psutil
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import BaseCallback

from sb3_yann import ImprovementGuard, NoActionNoise

STEPS = int(os.environ.get("LONG_STEPS", 40_000))
pytestmark = pytest.mark.filterwarnings("ignore")


class Usage(BaseCallback):
    """Samples memory (MB), open files and threads twenty times."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[float, int, int]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % (STEPS // 20) == 0:
            process = psutil.Process()
            memory = process.memory_info().rss / 1e6
            self.rows.append((memory, process.num_fds(), process.num_threads()))
        return True


@pytest.mark.skipif(not hasattr(psutil.Process, "num_fds"), reason="no count of open files")
def test_nothing_grows(tmp_path) -> None:
    model = DDPG(
        "YannPolicy", "CSTR-v0", device="cpu", seed=0, train_freq=16, tau=0.02, buffer_size=5_000
    )
    guard = ImprovementGuard(
        "CSTR-v0", n_eval_episodes=10, eval_freq=10, log_path=tmp_path / "guard.csv"
    )
    usage = Usage()
    model.learn(STEPS, callback=[NoActionNoise(), guard, usage])
    memory, files, threads = np.array(usage.rows).T
    assert memory[-5:].mean() < 1.05 * memory[8:12].mean()
    assert files[-1] <= files[10]
    assert threads[-1] <= threads[10]
