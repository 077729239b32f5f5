"""A policy on an env in the plant's own units is the MPC, exactly, and says what it cannot know."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import configure

import unit_samples as units
from sb3_yann import (
    ControlDiagnostics,
    CostAudit,
    ImprovementGuard,
    LinearMPC,
    NoActionNoise,
    NonFiniteWarning,
    Tracking,
    YannPolicy,
)
from sb3_yann.commissioning.plant import Plant
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.replay_buffer import episodes_of
from sb3_yann.wrappers import Deviations, SetPoint, StageCost

MPC = units.absolute_mpc()
ALL = [(shows, takes) for shows in units.SHOWS for takes in units.TAKES]
both = pytest.mark.parametrize(("shows", "takes"), ALL, ids="-".join)


def build(env: Any, observation: Any = None, mpc: LinearMPC = MPC, **kwargs: Any) -> DDPG:
    policy = {"problem": mpc, **({} if observation is None else {"observation": observation})}
    settings = {"seed": 0, "buffer_size": 1000, "device": "cpu", "gamma": 0.99, **kwargs}
    return DDPG(YannPolicy, env, policy_kwargs=policy, **settings)


def error(model: Any, env: Any, x: np.ndarray) -> float:
    """Return how far `predict` is from the law on the plant, as a fraction of the input range."""
    plain = env.unwrapped
    actions, _ = model.predict(plain.shows(x).astype(plain.dtype))
    return float(np.max(np.abs(plain.input(actions) - MPC.explicit()(x)))) / 7


@both
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_policy_is_the_mpc_whatever_the_units(shows: str, takes: str, dtype: type) -> None:
    env = units.plant(shows, takes, dtype)
    model = build(env, units.SAYS[shows])
    assert model.policy.input_units.kind == takes
    assert error(model, env, units.states(2000, seed=1)) < 1e-5


def test_an_absolute_problem_on_an_absolute_env_needs_no_word() -> None:
    env = units.plant("absolute", "absolute")
    model = build(env)
    shown = units.states(100, seed=2) + units.X_SS
    u = MPC.explicit().plant_input(shown)
    assert np.max(np.abs(model.predict(shown)[0] - u)) < 7e-5


def test_small_deviations_of_a_large_value_keep_their_digits() -> None:
    env = units.plant("absolute", "absolute", np.float64)
    model = build(env)
    x = units.states(500, seed=3, reach=1e-5)  # 1e-4 K of 350 K
    theta = model.policy.theta(x + units.X_SS).numpy()
    assert theta.dtype == np.float64 and np.max(np.abs(theta - x)) < 1e-12


@both
def test_cost_critic_and_logs_count_from_the_operating_point(shows: str, takes: str) -> None:
    """CostAudit, ControlDiagnostics, the replay buffer and the twin's log see the same theta."""
    env = StageCost(units.plant(shows, takes), MPC, observation=units.SAYS[shows])
    model, audit = build(env, units.SAYS[shows]), CostAudit(steps=60)
    model.set_logger(configure(None, []))
    model.learn(100, callback=[NoActionNoise(), ControlDiagnostics(), audit])
    assert audit.finding.matches, audit.finding.message
    logged = model.logger.name_to_value
    assert logged["yann/distance_from_mpc_max"] < 1e-6
    assert logged["yann/critic_error"] < 0.02
    for thetas, inputs in episodes_of(model):
        assert np.max(np.abs(thetas)) < 2
        np.testing.assert_allclose(thetas[1:], MPC.predict(thetas[:-1], inputs), atol=1e-6)


@both
def test_the_critic_is_the_value_of_the_law_in_any_units(shows: str, takes: str) -> None:
    env = units.plant(shows, takes)
    policy = build(env, units.SAYS[shows]).policy
    x = units.states(50, seed=4, reach=0.01)
    seen = th.as_tensor(env.unwrapped.shows(x))
    q = policy.critic.q1_forward(seen, policy.actor(seen)).detach().numpy()[:, 0]
    P = MPC.value_matrix(0.99)
    np.testing.assert_allclose(q, -np.sum((x @ P) * x, axis=1), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(("shows", "takes"), [("absolute", "absolute"), ("normalized",) * 2])
def test_a_model_that_is_loaded_reads_the_same(shows: str, takes: str, tmp_path: Any) -> None:
    env = units.plant(shows, takes)
    mpc = units.deviation_mpc() if takes == "normalized" else MPC
    build(env, units.SAYS[shows], mpc).save(tmp_path / "model.zip")
    model = DDPG.load(tmp_path / "model.zip", env=env, device="cpu")
    assert error(model, env, units.states(100, seed=5)) < 1e-5
    model.policy.save(tmp_path / "policy.zip")
    policy = YannPolicy.load(tmp_path / "policy.zip", device="cpu")
    assert error(policy, env, units.states(100, seed=5)) < 1e-5


def test_a_loaded_model_goes_on_showing_deviations(tmp_path: Any) -> None:
    """Its problem alone would say that an absolute env shows absolute values."""
    env = units.plant("deviation", "absolute")
    build(env, "deviation").save(tmp_path / "model.zip")
    model = DDPG.load(tmp_path / "model.zip", env=env, device="cpu")
    assert model.policy.observation is None
    assert error(model, env, units.states(100, seed=6)) < 1e-5


@pytest.mark.parametrize(("shows", "takes"), [("absolute", "absolute"), ("normalized",) * 2])
def test_commissioning_plays_the_plant_in_its_units(shows: str, takes: str) -> None:
    env = units.plant(shows, takes)
    played = Plant(env, build(env, units.SAYS[shows]))
    episode = played.play(played.begin(3), played.mpc, None)
    law = MPC.explicit()(episode.thetas[:-1])
    np.testing.assert_allclose(episode.actions, law, atol=1e-5)
    moved = MPC.predict(episode.thetas[:-1], episode.actions)
    np.testing.assert_allclose(episode.thetas[1:], moved, atol=1e-5)


def test_the_guard_s_simulator_shows_what_the_plant_shows() -> None:
    make = partial(units.plant, "absolute", "absolute")
    model = build(make())
    guard = ImprovementGuard(make, n_eval_episodes=4, n_new_starts=4)
    model.learn(100, callback=[NoActionNoise(), guard])
    evidence = guard.state.evidence
    plain = partial(units.plant, "deviation", "deviation")
    expected = evaluate(MPC.explicit(), plain, evidence.starts.seeds)
    np.testing.assert_allclose(evidence.starts.mpc.costs, expected.costs, rtol=1e-5)


def refused(env: Any, observation: Any = None, mpc: LinearMPC = MPC) -> str:
    with pytest.raises((ValueError, TypeError)) as caught:
        build(env, observation, mpc)
    return str(caught.value)


def test_what_an_env_shows_is_not_guessed() -> None:
    stated_in_deviations = refused(units.plant("absolute", "absolute"), mpc=units.deviation_mpc())
    assert "takes absolute inputs" in stated_in_deviations
    normalized = refused(units.plant("normalized", "normalized"))
    for message in (stated_in_deviations, normalized):
        assert "policy_kwargs={'observation': 'deviation'}, 'absolute', or {'center'" in message
    centered = LinearMPC(
        replace(units.MODEL, u_ss=[0.0]), Q=np.eye(2), R=[[1]], horizon=2, absolute=True,
        **{**units.LIMITS, "u_min": -2, "u_max": 5},
    )  # fmt: skip
    assert "u_ss is zero" in refused(units.plant("absolute", "deviation"), mpc=centered)


def test_other_bounds_of_the_inputs_are_named_in_both_units() -> None:
    env = RescaleAction(units.plant("absolute", "absolute"), 0.0, 1.0)
    message = refused(env)
    assert "[[0.0], [1.0]]" in message and "[-2.0]" in message and "[38.0]" in message


@pytest.mark.parametrize(
    ("said", "message"),
    [("plant", "must be one of"), (3, "must be an AffineObservation, 'deviation'"),
     ({"center": [1, 2]}, "must have a 'center' and a 'scale'"),
     ({"center": [1, 2], "scale": [0, 1]}, "must not be zero"),
     ({"center": [1], "scale": [1, 1]}, r"observation\['center'\] has shape \(1,\)")],
)  # fmt: skip
def test_another_word_for_what_is_shown_is_refused(said: Any, message: str) -> None:
    assert re.search(message, refused(units.plant("absolute", "absolute"), said))


def test_absolute_states_in_a_policy_of_deviations_are_named_once() -> None:
    env = units.plant("absolute", "deviation")
    model = build(env)
    expected = r"state 'temperature' = 35\d.* the operating point is 350: .*Deviations\(env, mpc"
    with pytest.warns(UserWarning, match=expected):
        model.predict(env.reset(seed=0)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(env.reset(seed=1)[0])


def test_deviations_in_a_policy_of_absolute_values_are_named_as_training_begins() -> None:
    model = build(units.plant("deviation", "absolute"))
    with pytest.warns(UserWarning, match=r"the env shows deviations, .*'observation': 'deviation'"):
        model.learn(3, callback=NoActionNoise())


@pytest.mark.parametrize(("shows", "takes"), ALL, ids="-".join)
def test_what_is_read_rightly_is_not_named(shows: str, takes: str) -> None:
    env = units.plant(shows, takes)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build(env, units.SAYS[shows]).predict(env.reset(seed=0)[0])
        build(Deviations(units.OwnUnits("absolute", "absolute"), MPC.model)).predict(np.zeros(2))


@pytest.mark.parametrize("shows", units.SHOWS)
def test_a_reading_that_is_lost_is_called_by_its_name(shows: str) -> None:
    """The law then acts at the operating point of that state, in any units."""
    env = units.plant(shows, "absolute")
    model, x = build(env, units.SAYS[shows]), np.array([0.0, 0.7])
    seen = np.where([True, False], np.nan, env.unwrapped.shows(x))
    with pytest.warns(NonFiniteWarning, match=r"not finite in entries \[0\] \(temperature\)"):
        action = model.predict(seen)[0]
    assert env.unwrapped.input(action) == pytest.approx(MPC.explicit()(x), abs=1e-5)


@pytest.mark.parametrize(
    ("absolute", "low", "high", "message"),
    [
        (True, -5.0, 5.0, r"takes absolute values from 345 to 355: these are deviations"),
        (False, 345.0, 355.0, r"takes deviations from -5 to 5: these are absolute values"),
    ],
)
def test_set_points_in_other_units_than_the_policy_s_are_named(
    absolute: bool, low: float, high: float, message: str
) -> None:
    given = {"Q": np.eye(2), "R": [[0.1]], "horizon": 2, "gamma": 0.99, "absolute": True}
    mpc = LinearMPC(units.MODEL, tracking=Tracking([0], 345, 355), **given, **units.LIMITS)
    plant = units.plant("absolute", "absolute")
    plant = plant if absolute else Deviations(plant, mpc.model)
    bounds = (345, 355) if absolute else (-5, 5)
    right = SetPoint(plant, *bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build(right, mpc=mpc).predict(right.reset(seed=0)[0])
    wrong = SetPoint(plant, low, high)
    with pytest.warns(UserWarning, match=message):
        build(wrong, mpc=mpc).predict(wrong.reset(seed=0)[0])


def test_a_plant_that_lacks_a_part_of_theta_is_told_of_the_wrappers() -> None:
    design = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 2, "absolute": True, **units.LIMITS}
    mpc = LinearMPC(units.MODEL, tracking=Tracking([0], 349, 351), **design)
    with pytest.raises(ValueError, match=r"takes theta of shape \(3,\).*SetPoint"):
        build(units.plant("absolute", "absolute"), mpc=mpc)
