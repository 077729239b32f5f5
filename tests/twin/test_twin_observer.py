"""A twin of a plant whose disturbance is estimated: the observer is a part of it."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

from errors import told
from improvement_samples import quick
from sample_plants import Sampled
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    PlantEnv,
    PlantTwin,
    Tracking,
    improve,
    offset_free,
    with_extra,
)
from sb3_yann._validation import Array
from sb3_yann.env_pool import observer_of
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.log import Episode, warn_of_estimates
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.wrappers import EstimateState, SetPoint
from twin_samples import (
    D_MAX,
    DT,
    Cart,
    observed,
    observed_env,
    observed_log,
    offset_free_problem,
    problem,
)


class Same(Cart):
    """A plant that is a member of the twin."""

    def __init__(self, dynamics: Dynamics) -> None:
        super().__init__()
        self.dynamics = dynamics

    def moved(self, u: Any) -> Any:
        row = self.dynamics.row
        rest = np.zeros(self.dynamics.problem.n_theta - 2)
        before = row.begin(np.array([*self.x, *rest]))
        after = self.dynamics.step(before[None, None], np.clip(u, -1, 1)[None, None])
        return after[0, 0, row.state]


def test_the_twin_s_env_is_the_wrapped_plant_step_by_step() -> None:
    found = observed()
    clipped = 0
    dynamics = found.dynamics
    member = Dynamics(found.problem, dynamics.coordinates, dynamics.members[2:3])
    plant = observed_env(Same(member))
    env = found.env()
    over = False
    shown, _ = plant.reset(seed=3)
    env.reset(seed=2, options={"state": shown.astype(float)})
    rng = np.random.default_rng(0)
    law = found.problem.explicit()
    while not over:
        u = np.float32(np.clip(law(shown) + 0.2 * rng.standard_normal(1), -1, 1))
        shown, _, _, over, _ = plant.step(u)
        inside, *_ = env.step(u)
        moving = [0, 1, 3, 4]  # the set-points are those of the log
        np.testing.assert_allclose(inside[moving], shown[moving], rtol=0, atol=1e-6)
        clipped += bool(np.any(np.abs(shown[3:]) >= np.float32(D_MAX)))
    assert clipped > 5


@pytest.mark.filterwarnings("ignore:For 50 steps")
@pytest.mark.parametrize("begin", [0, 20])
def test_the_log_tells_what_was_measured_and_estimated(begin) -> None:
    mpc, observer = offset_free_problem()
    row = RowLayout(mpc, observer)
    clipped = 0
    for thetas, actions, states, estimates in observed_log(plant=Cart()):
        rows, inputs = row.recovered(thetas[begin:].astype(float), actions[begin:].astype(float))
        lost = begin + (begin > 0)  # what was measured amid an estimate is not known
        assert len(rows) == len(thetas) - lost and len(inputs) == len(rows) - 1
        np.testing.assert_array_equal(row.shown(rows), thetas[lost:])
        clipped += int((np.abs(estimates) >= D_MAX)[lost:, 2:].sum())
        np.testing.assert_allclose(rows[:, row.state], states[lost:], atol=1e-6)
    assert clipped > 5


def test_an_observer_is_run_over_a_log_of_measurements() -> None:
    mpc, observer = offset_free_problem()
    log = observed_log()
    measured = [(states, actions) for _, actions, states, _ in log]
    wanted = [thetas[:, 2:3] for thetas, *_ in log]
    twin = PlantTwin.fit(mpc, measured, references=wanted, observer=observer)
    for ours, each in zip(twin.episodes, observed().episodes, strict=True):
        np.testing.assert_allclose(ours.thetas, each.thetas, atol=1e-6)
    assert twin.kind == observed().kind


def test_it_learns_what_an_estimate_that_is_taken_for_measured_hides() -> None:
    mpc = offset_free_problem()[0]
    found = observed()
    assert found.trusted and found.trust.cost_error < 1e-3
    with pytest.warns(UserWarning, match="Pass observer="):
        blind = PlantTwin.fit(mpc, [each[:2] for each in observed_log()])
    assert blind.trust.cost_error > 10 * found.trust.cost_error


def test_a_measured_disturbance_is_not_taken_for_an_estimate() -> None:
    model = LinearModel([[1.0, DT], [0.0, 0.95]], [[0.0], [DT]], DT, E=[[0.0], [1.0]])
    plain = problem()
    rng = np.random.default_rng(0)
    mpc = LinearMPC(
        model, Q=plain.Q, R=plain.R, horizon=2, u_min=-1, u_max=1, theta_min=[-3, -3],
        theta_max=[3, 3], disturbances=DisturbanceBounds(-0.2, 0.2),
    )  # fmt: skip
    episodes = []
    loads = []
    for _ in range(3):
        x = np.zeros(2)
        d = np.zeros(1)
        rows = []
        for _ in range(60):
            rows.append([x, rng.uniform(-1, 1, 1), d])
            x = model.A @ x + model.B @ rows[-1][1] + 1.2 * model.E @ d + 0.01 * x**2
            d = np.clip(0.9 * d + 0.03 * rng.standard_normal(1), -0.2, 0.2)
        states, inputs, load = (np.array(each) for each in zip(*rows, strict=True))
        episodes.append((states, inputs[:-1]))
        loads.append(load)
    given = {"disturbances": loads, "residuals": ["linear"], "n_members": 1}
    PlantTwin.fit(mpc, episodes, **given)  # a warning would be an error


def followed(steps: int, noise: float = 0.0, still: bool = False) -> Episode:
    """Return an episode whose disturbance follows the model's errors, but for some noise."""
    mpc, _ = offset_free_problem()
    rng = np.random.default_rng(0)
    thetas = np.zeros((steps + 1, mpc.n_theta))
    u = rng.uniform(-1, 1, (steps, 1))
    errors = 0.01 * rng.standard_normal((steps, 2))
    for k in range(steps):
        ahead = mpc.predict(thetas[k], u[k])
        thetas[k + 1] = ahead
        thetas[k + 1, :2] += errors[k]
        if not still:
            moves = [0.2 * errors[k, 0], 0.1 * errors[k, 1] - 0.1 * errors[k, 0]]
            own = noise * 1e-3 * rng.standard_normal(2)
            thetas[k + 1, 3:] = thetas[k, 3:] + np.array(moves) + own
    return Episode(thetas, u)


def warned(*episodes: Episode) -> bool:
    return bool(told(lambda: warn_of_estimates(offset_free_problem()[0], episodes)))


def test_a_disturbance_that_moves_with_the_errors_is_an_estimate_and_a_noisy_one_is_not() -> None:
    assert warned(followed(20)) and warned(followed(9), followed(9))
    assert not warned(followed(20, noise=3.0))
    assert not warned(followed(20, still=True))


def test_the_slopes_of_a_step_are_those_of_differences_on_bounds_of_d_as_well() -> None:
    found = observed()
    rng = np.random.default_rng(0)
    dynamics = found.dynamics
    row = found.dynamics.row
    at = np.array([found.starts.draw_logged(40, rng) for _ in dynamics.members])
    d = row.problem.layout.disturbance
    at[..., d] = D_MAX * rng.uniform(-1, 1, at[..., d].shape)
    u = rng.uniform(-0.9, 0.9, (*at.shape[:2], 1))
    A, B = dynamics.jacobians(at, u)
    step = 1e-6
    for j in range(row.size):
        moved = step * np.eye(row.size)[j]
        slope = (dynamics.step(at + moved, u) - dynamics.step(at - moved, u)) / (2 * step)
        np.testing.assert_allclose(A[..., j], slope, atol=1e-6)
    slope = (dynamics.step(at, u + step) - dynamics.step(at, u - step)) / (2 * step)
    np.testing.assert_allclose(B[..., 0], slope, atol=1e-6)
    on_bound = np.abs(dynamics.step(at, u)[..., 3:5]) == D_MAX
    assert on_bound.any() and not on_bound.all()


def test_starts_begin_with_the_estimate_of_an_observer_that_begins() -> None:
    found = observed()
    rng = np.random.default_rng(0)
    row = found.dynamics.row
    for drawn in (found.starts.draw_between(50, rng), found.starts.draw(50, rng)):
        assert drawn.shape == (50, row.size)
        np.testing.assert_array_equal(drawn[:, row.state], drawn[:, :2])
        np.testing.assert_array_equal(drawn[:, [3, 4]], 0.0)
    assert all(each.shape == (5,) for each in found.starts.shown)


def test_the_observer_is_found_among_the_wrappers() -> None:
    _, observer = offset_free_problem()
    for nobody in (gym.make("CSTR-v0"), None, "CSTR-v0", Cart, observed_env):
        assert observer_of(nobody) is None
    assert observer_of(DummyVecEnv([Cart])) is None
    env = gym.wrappers.TimeLimit(observed_env(), 30)
    assert np.array_equal(observer_of(env).gain, observer.gain)
    assert observer_of(observed().env()) is observed().dynamics.row.observer


def test_an_observer_of_another_model_is_refused() -> None:
    mpc, observer = offset_free_problem()
    log = [each[:2] for each in observed_log()]
    with pytest.raises(TypeError, match="observer = 'mine' must be a StateEstimator"):
        PlantTwin.fit(mpc, log, observer="mine")
    with pytest.raises(ValueError, match=r"observer has \(2, 1, 2\) .* the problem \(2, 1, 0\)"):
        RowLayout(problem(), observer)


@pytest.mark.parametrize(
    ("C", "block", "told"),
    [
        (np.eye(2), [[0.5, 0.0], [0.0, 0.0]], False),
        ([[1.0, 0.0], [1.0, 1e-11]], [[0.5, 0.0], [0.0, 0.5]], False),
        ([[1.0, 0.0], [1.0, 1e-9]], [[0.5, 0.0], [0.0, 0.5]], True),
    ],
)
def test_a_row_is_theta_where_the_observer_does_not_tell_the_state(C, block, told) -> None:
    model = LinearModel([[0.9, 0.0], [0.0, 0.5]], [[0.0], [1.0]], DT, E=[[1.0], [0.0]])
    mpc = LinearMPC(
        model, Q=np.eye(2), R=[[1.0]], horizon=1, u_min=-1, u_max=1, theta_min=-3, theta_max=3,
        disturbances=DisturbanceBounds(-0.1, 0.1),
    )  # fmt: skip
    observer = DisturbanceObserver(model, gain=[*block, [0.1, 0.0]])
    observer.C = np.array(C)
    assert RowLayout(mpc, observer).size == 3 + (2 if told else 0)


MODEL = LinearModel([[0.7, 0.0], [0.2, 0.8]], [[0.3], [0.0]], dt=1.0, C=[[0, 1]])
LIMITS = {"theta_min": -4, "theta_max": 4, "u_min": -2, "u_max": 2}
BASE = LinearMPC(
    MODEL, Q=np.diag([0, 1]), R=[[0.01]], horizon=4, tracking=Tracking([1], -1.5, 1.5), **LIMITS
)


def test_estimates_beside_a_load_that_is_foreseen_keep_their_own_bounds() -> None:
    loads = {"disturbances": DisturbanceBounds(-1, 1, preview=2), "terminal": None, **LIMITS}
    model = replace(MODEL, E=[[1], [0]], d_ss=[0])
    row = RowLayout(*offset_free(replace(BASE, model=model, **loads)))
    assert row.inputs.tolist() == [0, 1, 3, 6, 7]  # of [x, r, d, d ahead, d estimated, u]
    assert np.flatnonzero(row.spread.any(axis=1)).tolist() == [0, 1, 6]
    found = row.run(np.full((9, 1), 3.0), np.zeros((8, 1)), np.zeros((9, 1)))
    assert found[1].max() == row.problem.disturbances.d_max[1]


class Valve(Sampled):
    """A level behind a valve that nobody measures: far open it opens less and less."""

    observation_space = spaces.Box(-9.0, 9.0, (1,), np.float64)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float64)

    def reset(self, **given: Any) -> tuple[Array, dict[str, Any]]:
        super().reset(**given)
        self.x = self.np_random.uniform(-0.5, 0.5, 2)
        return self.shown(), {}

    def shown(self) -> Array:
        return self.x[1:].copy()

    def moved(self, u: Array) -> Array:
        valve, level = self.x
        after = 0.7 * valve + 0.3 * float(u[0])
        return np.array([after, 0.8 * level + 0.5 * np.tanh(0.9 * valve)])


def plant() -> gym.Env[Any, Any]:
    return TimeLimit(SetPoint(Valve(), -1.5, 1.5, hold=20), 40)


MPC, ESTIMATOR = offset_free(BASE, d_max=1.0)


def seen() -> gym.Env[Any, Any]:
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
    assert told.trusted == known.trusted and "outputs follow" not in told.report()
    for row, early, late in (("before", 1, 0), ("after", 0, 1)):
        parts = [slice(late, len(each) - early) for each in r]
        pairs = [(y[a], u[early : len(u) - late]) for (y, u), a in zip(outputs, parts, strict=True)]
        moved = PlantTwin.fit(MPC, pairs, references=[each[1:] for each in r], **options)
        assert f"The outputs follow the inputs of the row {row}" in moved.report()
    closed = PlantTwin.fit(MPC, [(y, -u) for y, u in outputs], references=r, **options)
    assert "u[0] moves the plant against the sign" in closed.report()
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
def test_a_policy_from_outputs_alone_is_no_worse_on_the_plant(hidden, monkeypatch) -> None:
    """Plans are made in a model of the estimates, and checked as any other from a log."""
    quick(monkeypatch)
    found = improve(MPC, hidden, rounds=1, n_starts=6, updates=300)
    assert found.where == "the twin" and not found.steps
    assert found.checks  # a candidate was taught and judged
    before, after = ([cost(act, k) for k in range(900, 910)] for act in (law, learnt(found)))
    assert np.mean(after) <= (1 + 1e-6) * np.mean(before)


def learnt(found: Any) -> Any:
    return lambda theta: found.model.predict(theta)[0]


def cost(policy: Any, seed: int) -> float:
    thetas, outputs, inputs, _ = played(policy, seed)
    thetas[:, 1] = outputs
    return float(MPC.stage_cost(thetas[:-1], inputs).sum())


def test_measured_disturbances_stay_beside_estimated_ones() -> None:
    """Those are given, these are moved: extra signals and an estimator in one simulator."""
    mpc, estimator = offset_free(with_extra(BASE, -1, 1), d_max=1.0)
    assert mpc.layout.names == ("x[0]", "x[1]", "r[0]", "d[0]", "d[1]")
    row = RowLayout(mpc, estimator)
    assert row.given == slice(2, 4)


def test_bounds_that_change_are_those_of_the_log_beside_an_estimated_disturbance() -> None:
    problem = LinearMPC(
        LinearModel([[0.9]], [[0.1]], 1.0), Q=[[1]], R=[[0.1]], horizon=3, u_min=-1, u_max=1,
        theta_min=-2, theta_max=2, parametric_bounds=["u_max"], tracking=Tracking([0], -0.5, 0.5),
    )  # fmt: skip
    mpc, observer = offset_free(problem)
    options = {"hold": 10, "observer": observer, "max_episode_steps": 40}
    env = PlantEnv(lambda x, u: np.log(0.9) * (x - 0.9 * u), mpc, **options)
    log = evaluate(mpc.law(), env, seeds=range(6)).pairs
    twin = PlantTwin.fit(mpc, log, observer=observer, residuals=["none", "linear"])
    assert twin.trusted, twin.report()
