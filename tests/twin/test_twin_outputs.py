"""Learning where not all states are measured: on the estimator's states and disturbances."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from sb3_yann import (
    LinearModel,
    LinearMPC,
    PlantTwin,
    Tracking,
    improve,
    offset_free,
    with_extra,
)
from sb3_yann._validation import Array
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.wrappers import EstimateState, SetPoint

MODEL = LinearModel([[0.7, 0.0], [0.2, 0.8]], [[0.3], [0.0]], dt=1.0, C=[[0, 1]])
LIMITS = {"theta_min": -4, "theta_max": 4, "u_min": -2, "u_max": 2}
BASE = LinearMPC(
    MODEL, Q=np.diag([0, 1]), R=[[0.01]], horizon=4, tracking=Tracking([1], -1.5, 1.5), **LIMITS
)


class Valve(gym.Env[Array, Array]):
    """A level behind a valve that nobody measures: far open it opens less and less."""

    observation_space = spaces.Box(-9.0, 9.0, (1,), np.float64)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin near rest."""
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-0.5, 0.5, 2)
        self.load = float(self.np_random.uniform(-1, 1))
        return self.x[1:].copy(), {"disturbance": self.load}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Step the plant."""
        valve, level = self.x
        after = 0.7 * valve + 0.3 * float(action[0])
        moved = 0.8 * level + 0.5 * np.tanh(0.9 * valve) + 0.0 * self.load
        self.x = np.array([after, moved])
        return self.x[1:].copy(), 0.0, False, False, {"disturbance": self.load}


def plant() -> gym.Env[Any, Any]:
    """Return the plant with set-points."""
    return TimeLimit(SetPoint(Valve(), -1.5, 1.5, hold=20), 40)


MPC, ESTIMATOR = offset_free(BASE, d_max=1.0)


def seen() -> gym.Env[Any, Any]:
    """Return the plant as the policy sees it."""
    return EstimateState(plant(), ESTIMATOR, -1, 1)


def played(policy: Any, seed: int, push: float = 0.0) -> tuple[Array, Array, Array, Array]:
    """Return thetas, outputs, inputs and references of an episode."""
    env = seen()
    rng = np.random.default_rng(seed)
    theta = env.reset(seed=seed)[0]
    over = False
    thetas = [theta]
    outputs = [env.unwrapped.x[1]]
    inputs = []
    while not over:
        u = np.clip(policy(theta) + push * rng.uniform(-1, 1, 1), -2, 2)
        theta, _, _, over, _ = env.step(u)
        thetas.append(theta)
        outputs.append(env.unwrapped.x[1])
        inputs.append(u)
    rows = np.array(thetas, np.float64)
    return rows, np.array(outputs), np.array(inputs), rows[:, 2:3]


def law(theta: Array) -> Array:
    """Return the MPC's input."""
    return MPC.law().plant_input(np.asarray(theta, np.float64))


@pytest.fixture(scope="module")
def log() -> list[tuple[Array, Array, Array, Array]]:
    """Return twenty episodes of the MPC, with inputs moved at random."""
    return [played(law, seed, 0.5) for seed in range(500, 520)]


def test_a_row_steps_its_estimate_of_d_as_the_estimator_does(log: Any) -> None:
    """What the states' residual is, moves it: the innovation follows from either."""
    row = RowLayout(MPC, ESTIMATOR)
    assert row.observer is None and row.size == MPC.n_theta
    for thetas, _, inputs, _ in log[:3]:
        linear = np.hstack([thetas[:-1], inputs]) @ row.linear.T
        residual = (thetas[1:] - linear)[:, row.state]
        after = linear + residual @ row.spread.T
        np.testing.assert_allclose(after[:, [0, 1, 3]], thetas[1:, [0, 1, 3]], atol=2e-6)


def test_a_log_of_outputs_is_a_log_of_the_estimates(log: Any) -> None:
    """The estimator is run over it; a reading that is missing is predicted."""
    options: dict[str, Any] = {"observer": ESTIMATOR, "n_members": 2, "residuals": ["quadratic"]}
    r = [each[3] for each in log]
    outputs = [(each[1][:, None].copy(), each[2]) for each in log]
    told = PlantTwin.fit(MPC, outputs, references=r, **options)
    known = PlantTwin.fit(MPC, [(each[0], each[2]) for each in log], **options)
    shown = told.dynamics.row.shown
    for one, other in zip(told.episodes, known.episodes, strict=True):
        np.testing.assert_allclose(shown(one.thetas), shown(other.thetas), atol=2e-6)
    assert told.trusted == known.trusted
    outputs[0][0][7] = np.nan
    lacking = PlantTwin.fit(MPC, outputs, references=r, **options)
    assert np.isfinite(lacking.episodes[0].thetas).all()
    assert not np.array_equal(lacking.episodes[0].thetas[7:], told.episodes[0].thetas[7:])


@pytest.fixture(scope="module")
def hidden(log: Any) -> PlantTwin:
    """Return a twin of outputs that finds the valve."""
    pairs = [(each[1][:, None], each[2]) for each in log[:12]]
    r = [each[3] for each in log[:12]]
    kinds = ["none", "linear", "quadratic"]
    return PlantTwin.fit(MPC, pairs, references=r, observer=ESTIMATOR, residuals=kinds)


def test_a_state_that_no_sensor_shows_is_found_from_the_outputs(log: Any, hidden: Any) -> None:
    """Estimates alone predict no cost: the load that they hold is what the valve lacks."""
    assert hidden.trusted and hidden.kind.startswith("hidden states, quadratic")
    assert hidden.trust.cost_error < 0.15
    row = hidden.dynamics.row
    found = []
    valves = []
    for episode, (_, outputs, inputs, _) in zip(hidden.episodes, log, strict=False):
        valve = np.zeros(len(inputs) + 1)  # where it began is forgotten after ten samples
        for k, u in enumerate(inputs[:, 0]):
            valve[k + 1] = 0.7 * valve[k] + 0.3 * u
        states = episode.thetas[:, row.state]
        np.testing.assert_allclose(states[:, 1], outputs, atol=1e-6)
        found.append(states[10:, 0])
        valves.append(valve[10:])
    assert np.corrcoef(np.concatenate(found), np.concatenate(valves))[0, 1] > 0.95


def test_a_row_of_hidden_states_steps_its_estimate_as_the_estimator_does(hidden: Any) -> None:
    """And a start that is moved keeps what is not measured."""
    row = hidden.dynamics.row
    for episode in hidden.episodes[:3]:
        rows = episode.thetas
        steps = np.hstack([rows[:-1], episode.actions]) @ row.linear.T
        steps += (rows[1:] - steps)[:, row.state] @ row.spread.T
        row.clip(steps)
        np.testing.assert_allclose(steps[:, [0, 1, 3]], rows[1:, [0, 1, 3]], atol=2e-6)
    drawn = hidden.starts.draw(40, np.random.default_rng(0))
    np.testing.assert_allclose(drawn[:, row.state][:, 1], drawn[:, 1], atol=1e-12)
    assert np.std(drawn[:, row.state][:, 0]) > 0.05 > np.std(drawn[:, 0])


@pytest.mark.slow
def test_a_policy_from_outputs_alone_is_no_worse_on_the_plant(hidden: Any) -> None:
    """Plans are made in a model of the estimates, and checked as any other from a log."""
    found = improve(MPC, hidden, rounds=1, n_starts=6, updates=300)
    assert found.where == "the twin" and not found.steps
    assert found.checks  # a candidate was taught and judged
    before, after = ([cost(act, k) for k in range(900, 910)] for act in (law, learnt(found)))
    assert np.mean(after) <= (1 + 1e-6) * np.mean(before)


def learnt(found: Any) -> Any:
    """Return what was accepted as a function of theta."""
    return lambda theta: found.model.predict(theta)[0]


def cost(policy: Any, seed: int) -> float:
    """Return what an episode costs, by its true outputs."""
    thetas, outputs, inputs, _ = played(policy, seed)
    thetas[:, 1] = outputs
    return float(MPC.stage_cost(thetas[:-1], inputs).sum())


def test_measured_disturbances_stay_beside_estimated_ones() -> None:
    """Those are given, these are moved: extra signals and an estimator in one simulator."""
    mpc, estimator = offset_free(with_extra(BASE, -1, 1), d_max=1.0)
    assert mpc.layout.names == ("x[0]", "x[1]", "r[0]", "d[0]", "d[1]")
    row = RowLayout(mpc, estimator)
    assert row.given == slice(2, 4)
