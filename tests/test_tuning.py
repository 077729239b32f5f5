"""Search spaces for RL Zoo: trials keep the problem of their entry, workers share a study."""

from __future__ import annotations

import pytest

optuna = pytest.importorskip("optuna")
pytest.importorskip("rl_zoo3")

from sb3_yann import tuning  # noqa: E402


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
