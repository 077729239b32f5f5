"""Policies around a law that is solved online, or with one network for all of theta."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3 import DDPG, TD3

from policy_samples import POLICIES, build, scalar_mpc, starts, updates, with_full_buffer
from sb3_yann import LinearMPC, OnlineLawWarning, YannPolicy
from sb3_yann.control import OnlineLaw
from sb3_yann.control.mpc import linear_mpc
from sb3_yann.networks import SharedYannLayer
from weights import is_mpc

SHAPES = pytest.mark.parametrize(
    "options", [{"law": "online"}, {"networks": "shared"}, {"law": "online", "networks": "shared"}]
)


@POLICIES
@SHAPES
def test_it_starts_as_the_mpc_and_learns(algorithm, options) -> None:
    mpc = scalar_mpc(x_min=None, x_max=None, theta_min=-5, theta_max=5)
    model = with_full_buffer(algorithm, mpc, **options, critic_warmup=0)
    assert isinstance(model.actor.mu, SharedYannLayer)
    theta = starts(mpc, stretch=2.0)
    expected = mpc.online()(theta)
    assert np.abs(model.predict(theta)[0] - expected).max() < 1e-6 * 2
    assert is_mpc(model)
    updates(model, 20)
    assert not is_mpc(model)
    assert np.all(np.abs(model.predict(theta)[0]) <= 1)


@SHAPES
def test_it_is_saved_with_its_law_and_loaded_without_a_search(options, tmp_path, monkeypatch):
    mpc = scalar_mpc()
    model = with_full_buffer(TD3, mpc, **options, critic_warmup=0)
    updates(model, 5)
    model.save(tmp_path / "model.zip")
    theta = starts(mpc)
    if "law" in options:
        monkeypatch.setattr(LinearMPC, "explicit", None)
    again = TD3.load(tmp_path / "model.zip", device="cpu")
    assert np.array_equal(again.predict(theta)[0], model.predict(theta)[0])
    assert isinstance(again.actor.mu.base_law, OnlineLaw) == ("law" in options)
    model.policy.save(tmp_path / "policy")
    policy = YannPolicy.load(tmp_path / "policy", device="cpu")
    assert np.array_equal(policy.predict(theta)[0], model.predict(theta)[0])


def test_the_search_that_found_no_law_is_not_repeated_when_a_model_is_loaded(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 1)
    with pytest.warns(OnlineLawWarning, match="law='online'"):
        model = build(DDPG, scalar_mpc())
    assert isinstance(model.actor.mu, SharedYannLayer)
    model.save(tmp_path / "model.zip")
    again = DDPG.load(tmp_path / "model.zip", device="cpu")
    assert isinstance(again.actor.mu, SharedYannLayer)


def test_networks_per_region_need_regions() -> None:
    with pytest.raises(ValueError, match="needs the regions of an explicit law"):
        build(policy_kwargs={"law": "online", "networks": "per_region"})
    with pytest.raises(ValueError, match="networks = 'each' must be one of"):
        build(policy_kwargs={"networks": "each"})
    with pytest.raises(ValueError, match="law = 'none' must be one of"):
        build(policy_kwargs={"law": "none"})


def test_observations_that_are_sampled_again_are_not_solved_again() -> None:
    model, solved = with_full_buffer(law="online", critic_warmup=0), []
    known = model.policy.problem.online().known
    answers = known.function
    updates(model, 50)  # of 100 transitions
    known.function = lambda rows: solved.append(len(rows)) or answers(rows)
    updates(model, 20)
    assert sum(solved) < 0.05 * 20 * 2 * 16
