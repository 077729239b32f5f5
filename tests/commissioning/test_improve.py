"""A policy that is improved in a twin is better on the plant, or stays what it was."""

from __future__ import annotations

import copy
import importlib
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3

from sb3_yann import NoActionNoise, PlantTwin, UntrustedTwinError, YannPolicy, improve
from sb3_yann.commissioning import Improvement
from sb3_yann.commissioning.grounds import TwinGrounds
from sb3_yann.commissioning.search import Pace, Search
from sb3_yann.commissioning.trial import Check
from sb3_yann.evaluation import evaluate
from twin_samples import Cart, log, problem, twin
from weights import is_mpc


def reactor(seeds: range) -> PlantTwin:
    """Return the reactor's twin from episodes of its MPC."""
    model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    mpc = model.policy.problem
    played = evaluate(mpc.explicit(), "CSTR-v0", seeds)
    return PlantTwin.fit(mpc, [*zip(played.observations, played.actions, strict=True)])


@pytest.mark.slow
def test_on_the_reactor_five_episodes_are_enough_and_the_model_goes_on(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0", device="cpu", seed=0, learning_starts=0)
    found = improve(model, reactor(range(5)), iterations=60)
    assert found.accepted and found.change < -0.01
    seeds = range(500, 530)
    ours, mpc = (evaluate(each, "CSTR-v0", seeds) for each in (model, problem_law("CSTR-v0")))
    assert np.mean(ours.costs) < 0.99 * np.mean(mpc.costs)
    assert ours.violations.sum() == 0
    assert np.max(ours.costs - mpc.costs) < 0.005 * np.mean(mpc.costs)
    low, high = reactor(range(5)).starts.shown  # beyond what the log shows the MPC acts
    far = np.float32((low + high) / 2 + 0.8 * (high - low) * np.eye(4))
    plain = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    np.testing.assert_array_equal(model.predict(far)[0], plain.predict(far)[0])
    near = np.float32((low + high) / 2 + 0.4 * (high - low) * np.eye(4))
    assert not np.array_equal(model.predict(near)[0], plain.predict(near)[0])
    target, actor = model.actor_target.state_dict(), model.actor.state_dict()
    assert all(th.equal(target[name], value) for name, value in actor.items())
    model.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model", env=gym.make("CSTR-v0"))
    theta = np.float32([0.01, 0.1, -0.1, 1.0])
    np.testing.assert_array_equal(again.predict(theta)[0], model.predict(theta)[0])
    again.learn(20, callback=NoActionNoise())


def test_an_mpc_is_enough_and_the_result_holds_its_model(tmp_path) -> None:
    found = improve(problem(), twin(), iterations=4, batch=4, n_starts=4, check_every=4)
    assert isinstance(found.model, DDPG) and found.model.policy.problem == problem()
    assert found.export(tmp_path / "controller.npz").paths
    assert found.report() in str(found)
    assert found.model.improvements[-1].model is None  # no circle in the zip


def test_a_report_says_what_was_accepted_or_why_nothing_was() -> None:
    passed = Check(20, True, "", -0.021, 0.0004, True, -0.015, 0.003)
    refused = Check(40, False, "2 starts with violations", -0.03, 0.0, False)
    found = Improvement((passed, refused), -0.021, accepted=True)
    assert (
        str(found)
        == found.report()
        == (
            "Accepted: -2.10 % of the MPC's stage cost in the twin, -1.50 % (± 0.30) on episodes "
            "like the log's, +0.04 % from the worst start. 1 of 2 checks passed."
        )
    )
    assert Improvement((refused,), 0.0, accepted=False).report() == (
        "Nothing better was found: 2 starts with violations. In a twin the search makes no plans: "
        "headroom(mpc, twin) tells what they would gain there, and improve(model, simulator) "
        "begins at them. The model is as it was. "
        "0 of 1 checks passed."
    )


def problem_law(env_id: str):
    return DDPG("YannPolicy", env_id, device="cpu").policy.problem.explicit()


def policy_bits(model) -> dict[str, bytes]:
    return {name: each.numpy().tobytes() for name, each in model.policy.state_dict().items()}


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_where_nothing_passes_the_model_is_as_it_was(algorithm, monkeypatch) -> None:
    from sb3_yann.commissioning import trial

    monkeypatch.setattr(trial, "MARGIN", -1.0)  # no start can pass
    model = algorithm(YannPolicy, Cart(), seed=0, device="cpu")
    before = policy_bits(model)
    found = improve(model, twin(), iterations=3, check_every=1, n_starts=3)
    assert not found.accepted and found.change == 0 and is_mpc(model)
    assert policy_bits(model) == before
    assert {each.iteration for each in found.checks} == {1, 2, 3}


def test_no_random_state_is_moved_and_a_seed_repeats_it() -> None:
    states, numbers = [], []
    for _ in range(2):
        model = DDPG(YannPolicy, Cart(), seed=0, device="cpu")
        th.manual_seed(3)
        np.random.seed(3)  # noqa: NPY002 (the global state is what is looked at)
        improve(model, twin(), iterations=2, check_every=1, n_starts=3)
        numbers.append((float(th.rand(1)), float(np.random.rand())))  # noqa: NPY002
        states.append(policy_bits(model))
    th.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    assert numbers == [(float(th.rand(1)), float(np.random.rand()))] * 2  # noqa: NPY002
    assert states[0] == states[1]


def test_what_cannot_be_improved_is_refused_and_left() -> None:
    model = DDPG(YannPolicy, Cart(), device="cpu")
    before = copy.deepcopy(model.policy.state_dict())
    with pytest.raises(UntrustedTwinError, match="There is one episode"):
        improve(model, PlantTwin.fit(problem(), log(1)))
    with pytest.raises(ValueError, match=r"Fit the twin with model\.policy\.problem"):
        improve(DDPG("YannPolicy", "CSTR-v0", device="cpu"), twin())
    with pytest.raises(TypeError, match="twin = 3 must be a PlantTwin; or a simulator"):
        improve(model, 3)
    with pytest.raises(TypeError, match="improve needs a YannPolicy"):
        improve(DDPG("MlpPolicy", Cart(), device="cpu"), twin())
    for wrong in ({"iterations": 0}, {"batch": 0}, {"learning_rate": 0}, {"patience": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            improve(model, twin(), **wrong)
    after = model.policy.state_dict()
    assert all(th.equal(value, after[name]) for name, value in before.items())


def test_the_critic_is_refitted_to_the_returns_of_the_twin() -> None:
    from sb3_yann.commissioning.critic import _costs, refit_critic

    model, found = DDPG(YannPolicy, Cart(), seed=0, device="cpu"), twin()
    rng = np.random.default_rng(5)
    at = found.starts.draw_logged(500, rng)
    u = problem().explicit()(at) + 0.1 * rng.standard_normal((500, 1))
    u = np.clip(u, -1, 1)
    returns = -_costs(model.policy, found, model.actor.mu, at, u)
    known = np.isfinite(returns)

    def error() -> float:
        with th.no_grad():
            points = th.as_tensor(np.hstack([at, u]))
            off = model.critic.values(points)[0].numpy()[:, 0] - returns
            return float(np.abs(off[known]).mean())

    before = error()
    refit_critic(model.policy, found, seed=0)
    assert error() < 0.5 * before


def test_what_gains_next_to_nothing_changes_nothing(monkeypatch) -> None:
    module = importlib.import_module("sb3_yann.commissioning.improve")
    model = DDPG(YannPolicy, Cart(), seed=0, device="cpu")
    before = policy_bits(model)
    for name in ("LEAST", "LEAST_OF_EXACT"):
        monkeypatch.setattr(module, name, 1.0)  # nobody saves all of the cost
    found = improve(model, twin(), iterations=40)
    assert any(each.accepted for each in found.checks) and not found.accepted
    assert found.change == 0.0 and "Nothing better was found" in found.reason
    assert policy_bits(model) == before
    monkeypatch.undo()
    assert improve(model, twin(), iterations=40).accepted
    assert policy_bits(model) != before


@pytest.mark.parametrize(
    ("ratio", "error", "least"), [(0.9, 0.0, 2e-3), (0.4, 0.0, 2e-4), (0.4, 0.18, 0.018)]
)
def test_a_twin_must_promise_more_the_more_its_costs_err(ratio, error, least) -> None:
    module = importlib.import_module("sb3_yann.commissioning.improve")
    trust = SimpleNamespace(error_ratio=ratio, cost_error=error)
    assert module.least_gain(trust) == pytest.approx(least)


def test_what_the_costs_of_a_twin_err_by_asks_for_more_than_it_finds(monkeypatch) -> None:
    model = DDPG(YannPolicy, Cart(), seed=0, device="cpu")
    monkeypatch.setattr("sb3_yann.twin.trust.Trust.cost_error", 10.0)  # nobody saves all of it
    found = improve(model, twin(), iterations=40)
    assert any(each.accepted for each in found.checks) and not found.accepted


def test_of_what_is_refused_a_half_and_a_quarter_are_tried(monkeypatch) -> None:
    layer = copy.deepcopy(DDPG(YannPolicy, Cart(), seed=0, device="cpu").policy.actor.mu)
    search = Search(layer, TwinGrounds(twin(), n_runs=5, n_starts=2, seed=0), Pace(1, 1e-3, 1, 1))
    mpc = copy.deepcopy(search.accepted)
    for each in layer.network.parameters():
        th.nn.init.normal_(each, std=0.3)
    present, verdicts = copy.deepcopy(layer.state_dict()), iter([False, False, True])
    monkeypatch.setattr(search, "_try", lambda: Check(1, next(verdicts), "", -0.01, 0.0, True))
    assert search._check()
    for name, value in search.accepted.items():
        if name.startswith("network."):
            th.testing.assert_close(value, mpc[name] + (present[name] - mpc[name]) / 4)
    assert all(th.equal(value, present[name]) for name, value in layer.state_dict().items())
