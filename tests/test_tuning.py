"""Search spaces for RL Zoo: trials keep the problem of their entry, workers share a study."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

optuna = pytest.importorskip("optuna")
pytest.importorskip("rl_zoo3")

import sb3_yann  # noqa: E402
import sb3_yann_envs  # noqa: E402
from sb3_yann import tuning  # noqa: E402

ENTRY = """
ClippedPendulum-v0:
  n_timesteps: 250
  policy: "YannPolicy"
  learning_starts: 100
  policy_kwargs:
    problem: "my_problem:mpc"
    max_correction: 0.25
  callback: [sb3_yann.NoActionNoise]
"""
PROBLEM = """
from pathlib import Path
from sb3_yann_envs import problems
def mpc():
    Path("asked").touch()  # the trial's model was built with the entry's problem
    return problems.clipped_pendulum()
"""


def test_every_draw_builds_a_policy_that_is_the_mpc(monkeypatch):
    import numpy as np
    from stable_baselines3 import DDPG

    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    seen = set()
    for _ in range(12):
        drawn = tuning.sample(study.ask())
        model = DDPG("YannPolicy", "CSTR-v0", device="cpu", **drawn)
        law, theta = model.policy.problem.explicit(), np.float32([0.2, 0.1, -0.1, 1.0])
        assert np.allclose(model.predict(theta)[0], law(theta), atol=1e-4)
        assert model.policy.lr_mult["actor"] == drawn["policy_kwargs"]["actor_lr_mult"]
        seen.add(drawn["policy_kwargs"]["networks"])
    assert seen == {"per_region", "shared"}


def test_other_policies_keep_the_zoos_space():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    extra = {"using_her_replay_buffer": False, "her_kwargs": {}}
    assert "widths" not in HYPERPARAMS_SAMPLER["td3"](study.ask(), 1, 1, extra)
    trial = study.ask()
    HYPERPARAMS_SAMPLER["td3"](trial, 1, 1, extra)
    assert "one_minus_gamma" in trial.params and "critic_widths" not in trial.params


@pytest.mark.nightly
def test_two_workers_on_one_study_keep_the_entrys_problem(tmp_path):
    (tmp_path / "my_problem.py").write_text(PROBLEM)
    (tmp_path / "entry.yml").write_text(ENTRY)
    packages = {Path(each.__file__).parents[1] for each in (sb3_yann, sb3_yann_envs)}
    path = os.pathsep.join([str(tmp_path), *map(str, packages)])
    command = [
        sys.executable, "-m", "rl_zoo3.train", "--algo", "ddpg", "--env", "ClippedPendulum-v0",
        "--gym-packages", "sb3_yann", "sb3_yann.tuning", "--conf-file", "entry.yml",
        "-f", "logs", "-optimize", "--storage", "study.log", "--study-name", "swing",
        "--max-total-trials", "4", "--n-evaluations", "1", "--eval-episodes", "1",
        "--no-optim-plots", "--num-threads", "1", "--seed",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    workers = [
        subprocess.Popen(
            [*command, str(seed)],
            cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True,
        )
        for seed in (0, 1)
    ]  # fmt: skip
    printed = [worker.communicate(timeout=300)[0] for worker in workers]
    assert all(worker.returncode == 0 for worker in workers), printed
    storage = optuna.storages.journal.JournalFileBackend(str(tmp_path / "study.log"))
    study = optuna.load_study(study_name="swing", storage=optuna.storages.JournalStorage(storage))
    states = [trial.state.name for trial in study.trials]
    assert 4 <= len(states) <= 5 and set(states) <= {"COMPLETE", "PRUNED"}, (states, printed)
    assert "COMPLETE" in states
    assert (tmp_path / "asked").exists()
    assert "critic_widths" in study.best_trial.params
