"""Episodes in a learnt model are those of its steps; members that disagree have a price."""

import dataclasses
from dataclasses import replace
from functools import cache, partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG

from sb3_yann import LinearModel, LinearMPC, PlantTwin, YannPolicy, offset_free
from sb3_yann.control.mpc.bound_excess import bound_excess
from sb3_yann.improvement import simulator as module
from sb3_yann.improvement.imitation import Teacher, controller_of, policy_of, refine
from sb3_yann.improvement.improving import _Progress, _Work
from sb3_yann.improvement.simulator import (
    Disagreement,
    Excited,
    Family,
    Scenarios,
    Simulator,
    lacks,
    missed_of,
    model_of,
    of_law,
    one_step_error,
    task_of,
)
from sb3_yann.plan import TwinPlant, slopes_of_inputs
from sb3_yann.rollout import Trajectories
from sb3_yann.twin import selection
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.env import LearntModel
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import fit_ensemble
from sb3_yann.wrappers import EstimateState
from twin_samples import POLYNOMIALS, Cart, log, observed, problem, rated


@cache
def learnt() -> LearntModel:
    """Return a model of a few episodes of the cart, of which one is short."""
    seen = [Episode(*each) for each in log(4)]
    seen[1] = Episode(seen[1].thetas[:31], seen[1].actions[:30])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "fit_ensemble", partial(fit_ensemble, updates=200))
        return model_of(problem(), seen, None, seed=0)


def scenarios(found: LearntModel, each: bool = False) -> Scenarios:
    rng = np.random.default_rng(0)
    like = Scenarios.like(found, found.episodes[:4], rng)
    members = np.arange(4) % len(found.dynamics.members) if each else None
    return dataclasses.replace(like, members=members)


def by_hand(found: Scenarios) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (T + 1, k, size) and inputs of the law, step by step and one by one."""
    dynamics = found.model.dynamics
    law = found.model.problem.law()
    bounds = found.model.problem.deviations.u_min, found.model.problem.deviations.u_max
    row = dynamics.row
    rows = []
    inputs = []
    for i, start in enumerate(found.starts):
        at = start.copy()
        one = []
        us = []
        for t, given in enumerate(found.given[:, i]):
            at[row.given] = given
            us.append(np.clip(law(row.shown(at)), *bounds))
            every = [np.tile(v, (len(dynamics.members), 1, 1)) for v in (at, us[-1])]
            after = dynamics.step(*every)[:, 0]
            one.append(at)
            at = after.mean(axis=0) if found.members is None else after[found.members[i]]
            if found.missed is not None:
                at = at + row.spread @ found.missed[t, i]
                row.clip(at)
        rows.append([*one, at])
        inputs.append(us)
    return np.swapaxes(rows, 0, 1), np.swapaxes(inputs, 0, 1)


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("make", [learnt, rated, observed])
def test_an_episode_is_a_loop_of_the_members_steps(make, each) -> None:
    found = scenarios(make(), each)
    mpc = found.model.problem
    row = found.model.dynamics.row
    played = found.play(of_law(mpc))
    rows, inputs = by_hand(found)
    thetas = row.shown(rows)
    np.testing.assert_allclose(played.thetas, thetas, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(played.inputs, inputs, rtol=1e-9, atol=1e-12)
    excess = bound_excess(mpc, thetas, inputs)
    costs = mpc.stage_cost(thetas[:-1], inputs).sum(axis=0) + excess.penalty
    np.testing.assert_allclose(played.costs, costs)
    assert played.unsafe.shape == (len(found), 9) and not played.unsafe[:, :4].any()


def test_loads_and_noise_of_an_episode_that_nothing_measures_come_again() -> None:
    found = observed()
    seen = found.episodes[:4]
    like = Scenarios.like(found, seen, np.random.default_rng(0))
    assert like.missed is not None and np.abs(like.missed).max() > 0
    played = like.play(lambda t, theta, rows: np.array([each.actions[t] for each in seen]))
    for i in (0, 2):  # the others begin elsewhere
        np.testing.assert_allclose(played.rows[:-1, i], seen[i].thetas[:-1], atol=1e-9)


class Pushed(gym.Env):
    """A cart whose position alone is shown, pushed by another load in each episode."""

    model = LinearModel([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], dt=0.1, C=[[1.0, 0.0]])
    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.array([self.np_random.uniform(-0.5, 0.5), 0.0])
        self.load = self.np_random.uniform(-0.5, 0.5)
        return self.x[:1].astype(np.float32), {}

    def step(self, action):
        self.x = self.model.A @ self.x + self.model.B @ (action + self.load)
        return self.x[:1].astype(np.float32), 0.0, False, False, {}


def test_what_a_load_does_is_not_taken_for_what_answers_it(monkeypatch) -> None:
    monkeypatch.setattr(module, "fit_ensemble", partial(fit_ensemble, updates=300))
    box = {"theta_min": [-2.0, -2.0], "theta_max": [2.0, 2.0], "u_min": [-1.0], "u_max": [1.0]}
    mpc = LinearMPC(Pushed.model, Q=np.diag([1.0, 0.1]), R=[[0.1]], horizon=5, **box)
    mpc, observer = offset_free(mpc, [1.0])
    simulator = Simulator(mpc, lambda: EstimateState(TimeLimit(Pushed(), 60), observer), 0)
    simulator.begin()
    row = simulator.row
    episodes = tuple(simulator.episodes)
    usual, other = (
        simulator.learn(simulator.play(act, range(20)), range(20))
        for act in (of_law(mpc), Excited(mpc, 5))
    )
    states = np.stack([each.thetas[:, row.state] for each in other], axis=1)
    errors = []
    for known in (episodes, [replace(each, seed=None) for each in episodes]):
        like = Scenarios.like(model_of(mpc, known, observer, 0), usual, np.random.default_rng(0))
        like = replace(like, starts=row.begin(np.array([each.thetas[0] for each in usual])))
        played = like.play(lambda t, theta, rows: np.array([each.actions[t] for each in other]))
        errors.append(np.abs(played.rows[..., row.state] - states).max() / np.std(states))
    assert errors[0] < 1e-3
    assert errors[1] > 0.3  # what it would be if they had no seeds


@pytest.mark.parametrize("make", [learnt, observed])
def test_scenarios_go_on_from_where_an_episode_had_got_to(make) -> None:
    found = scenarios(make())
    law = of_law(found.model.problem)
    played = found.play(law)
    begins = np.array([0, 3, 7, 12])
    later = found.later(played.rows, begins).play(law)
    for i, begin in enumerate(begins):
        end = len(played.inputs) - begin
        np.testing.assert_allclose(later.thetas[:end, i], played.thetas[begin:-1, i], atol=1e-12)


def test_some_scenarios_begin_where_logged_episodes_had_got_to() -> None:
    found = learnt()
    rng = np.random.default_rng(0)
    like = Scenarios.like(found, found.episodes[:4], rng, midway=2)
    parts = found.dynamics.row
    for i in (2, 3):
        state = parts.shown(like.starts)[i, : found.problem.model.n_states]
        logged = found.episodes[i].thetas[:, parts.state]
        assert np.abs(logged - state).max(axis=1).min() < 1e-12
        assert not np.allclose(logged[0], state)


def test_a_scenario_that_is_planned_again_is_shown_anew() -> None:
    found = scenarios(learnt())
    teacher = Teacher(found, 0)
    teacher.show()
    first = {key: rows[0].copy() for key, rows in teacher.taught.items()}
    assert {*first} <= {(i, 0) for i in range(4)}
    act = policy_of(
        DDPG(YannPolicy, Cart(), policy_kwargs={"problem": problem()}).actor.mu, problem()
    )
    played = found.play(controller_of(act))
    teacher.known[2:] = False  # these begin at their start again
    played.costs[3] = np.inf  # lost: it counts twice in the next fit
    teacher.show(act, played)
    assert teacher.weights[3] == 2 and teacher.weights.max() == 2
    for key in ((2, 0), (3, 0)):
        assert not np.array_equal(first[key], teacher.taught[key][0])


@pytest.mark.parametrize("members", [None, [0, 1, 0]])
@pytest.mark.parametrize("make", [learnt, rated, observed])
def test_slopes_of_inputs_are_those_of_the_cost_with_the_feedback_at_work(make, members) -> None:
    found = make()
    rng = np.random.default_rng(0)
    some = Scenarios.like(found, found.episodes[:3], rng)
    some = replace(some, members=None if members is None else np.array(members))
    mpc = found.problem
    task = task_of(found, 1.0, priced=members is None)
    K = -0.05 * mpc.u_half[:, None] * rng.random((mpc.model.n_inputs, mpc.n_theta))
    moved = np.zeros((*some.given.shape[:2], mpc.model.n_inputs))

    def act(theta):
        return theta @ K.T

    def cost() -> np.ndarray:
        played = some.play(lambda t, theta, rows: act(theta) + moved[t])
        return task.costs(played.thetas, played.inputs)

    played = some.play(controller_of(act))
    slopes = slopes_of_inputs(some.plant, task, act, played.rows, played.inputs)
    for t, i in ((0, 0), (3, 1), (len(moved) - 1, 2)):
        both = []
        for side in (1e-5, -1e-5):
            moved[t, i, 0] = side * mpc.u_half[0]
            both.append(cost()[i])
        moved[:] = 0.0
        expected = (both[0] - both[1]) / (2e-5 * mpc.u_half[0])
        assert slopes[t, i, 0] == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_an_episode_counts_until_it_is_a_width_beyond_the_box_or_not_finite() -> None:
    simulator = Simulator(problem(), Cart, 0)
    width = np.ptp([problem().theta_min, problem().theta_max], axis=0)
    thetas, inputs = log(1)[0]
    for far, kept in ((0.9, len(inputs)), (1.1, 29), (np.nan, 29)):
        moved = thetas.copy()
        moved[30, 0] = problem().theta_max[0] + far * width[0]
        (episode,) = simulator.learn(Trajectories(None, None, (moved,), (inputs,), None), [0])
        assert len(episode) == kept
    simulator.close()


def test_a_policy_descends_to_what_costs_less_and_breaks_no_rule() -> None:
    teacher = Teacher(scenarios(learnt()), 0)
    layer = DDPG(
        YannPolicy, Cart(), policy_kwargs={"problem": problem(), "networks": "shared"}
    ).actor.mu
    saved = refine(layer, teacher, 150)
    played = teacher.play(layer)
    assert saved > 0 and saved == teacher.saved(played.costs)
    assert not teacher.objection(played)


def test_what_is_not_finite_is_lost_and_has_no_cost() -> None:
    found = scenarios(learnt())
    found.starts[2] = np.nan
    played = found.play(of_law(problem()))
    assert np.isinf(played.costs[2]) and played.unsafe[2, 2] == 1
    assert np.isfinite(played.costs[[0, 1, 3]]).all() and not played.unsafe[[0, 1, 3], 2].any()


@pytest.mark.parametrize("members", [None, [0, 1, 0]])
@pytest.mark.parametrize("make", [learnt, rated, observed])
def test_slopes_of_a_plant_are_those_of_its_steps(make, members) -> None:
    found = make()
    rng = np.random.default_rng(2)
    mpc = found.problem
    numbers = np.arange(3)
    size = 1e-6
    plant = TwinPlant(found.dynamics, members)
    half = 0.2 * mpc.theta_half
    theta = half * rng.uniform(-1, 1, (4, 3, mpc.n_theta))
    u = rng.uniform(-0.5, 0.5, (4, 3, 1))
    A, B = plant.jacobians(theta, u, numbers)
    held = mpc.layout.constant
    np.testing.assert_array_equal(plant.step(theta[0], u[0], numbers)[:, held], theta[0][:, held])
    for t in range(4):
        for j, e in enumerate(size * np.eye(mpc.n_theta)):
            ends = [plant.step(theta[t] + s * e, u[t], numbers) for s in (1, -1)]
            np.testing.assert_allclose(A[t, ..., j], (ends[0] - ends[1]) / 2e-6, atol=1e-5)
        ends = [plant.step(theta[t], u[t] + s * size, numbers) for s in (1, -1)]
        np.testing.assert_allclose(B[t, ..., 0], (ends[0] - ends[1]) / 2e-6, atol=1e-5)


@pytest.mark.parametrize("make", [learnt, rated])
def test_the_price_of_doubt_is_that_of_what_sets_members_apart(make) -> None:
    dynamics = make().dynamics
    rng = np.random.default_rng(3)
    doubt = Disagreement(dynamics, weight=2.5)
    n = dynamics.problem.n_theta
    thetas = rng.uniform(-0.8, 0.8, (5, 3, n))
    u = rng.uniform(-0.9, 0.9, (5, 3, 1))
    state = dynamics.row.state
    every = [np.tile(v.reshape(1, 15, -1), (len(dynamics.members), 1, 1)) for v in (thetas, u)]
    after = dynamics.step(*every)[..., state] / dynamics.coordinates.units
    price = 2.5 * after.var(axis=0).sum(axis=-1).reshape(5, 3)
    np.testing.assert_allclose(doubt.costs(thetas, u), price, rtol=1e-6)
    gradient, curvature = doubt.slopes(thetas, u)
    assert gradient.shape == (5, 3, n + 1) and curvature.shape == (5, 3, n + 1, n + 1)
    step = 1e-5
    for j, e in enumerate(step * np.eye(n + 1)):
        ends = [doubt.costs(thetas + s * e[:n], u + s * e[n:]) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(gradient[..., j], slope, rtol=1e-4, atol=1e-6 * price.max())
    np.testing.assert_allclose(curvature, np.swapaxes(curvature, -1, -2))
    assert np.linalg.eigvalsh(curvature).min() > -1e-9 * np.abs(curvature).max()


@pytest.mark.parametrize(
    ("noise", "bend", "wanted"),
    [(0.0, 0.0, (False, False)), (0.1, 0.0, (True, False)), (0.0, 0.3, (True, True))],
)
def test_what_a_model_lacks_is_told_from_noise(noise, bend, wanted) -> None:
    mpc = problem()
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(20):
        theta = rng.uniform(-1, 1, (41, mpc.n_theta))
        u = rng.uniform(-1, 1, (40, 1))
        rows = [theta[0]]
        for each in u:
            after = mpc.deviations.predict(rows[-1], each)
            rows.append(after + noise * rng.standard_normal(after.shape) + bend * np.sin(rows[-1]))
        episodes.append(Episode(np.array(rows), u))
    box = Coordinates.of(RowLayout(mpc), episodes)
    none = Residual.zero(len(box.scale), mpc.model.n_states)
    found = LearntModel(mpc, tuple(episodes), Dynamics(mpc, box, (none, none)))
    assert lacks(found) == wanted


@pytest.mark.parametrize(
    ("gain", "load", "noise"), [(0.5, 0.0, 0.0), (0.5, 0.1, 0.003), (0.0, 0.0, 0.1)]
)
def test_a_gain_that_differs_by_episode_makes_a_family_noise_does_not(
    monkeypatch, gain, load, noise
) -> None:
    monkeypatch.setattr(module, "fit_ensemble", partial(fit_ensemble, updates=500))
    monkeypatch.setattr(selection, "FAMILY_UPDATES", 200)
    mpc = problem()
    rng = np.random.default_rng(0)
    gains = 1 + gain * rng.uniform(-1, 1, 12)
    episodes = []
    for number, times in enumerate([*gains, *gains]):  # two of each seed
        rows = [rng.uniform(-1, 1, mpc.n_theta)]
        u = rng.uniform(-1, 1, (40, 1))
        for each in u:
            after = mpc.deviations.predict(rows[-1], times * each) + load * np.sin(number % 12)
            rows.append(after + noise * rng.standard_normal(after.shape))
        episodes.append(Episode(np.array(rows), u, number % 12))
    plain = model_of(mpc, episodes, None, 0)
    found = Family.of(plain, 0)
    if not gain:
        assert found is plain
        return
    left, before = (sum(np.sum(missed_of(m, e) ** 2) for e in episodes) for m in (found, plain))
    assert isinstance(found, Family) and left < 0.1 * before
    like = Scenarios.like(found, episodes[:12])
    acting = [found.dynamics.members[i] for i in like.members]
    effects = [each.jacobian(np.zeros((1, 3)))[0, 1, -1] for each in acting]
    assert np.corrcoef(effects, gains)[0, 1] > 0.95


def bounded() -> PlantTwin:
    """The cart's twin, whose MPC knows a bound on its speed."""
    mpc = replace(problem(), x_min=[-np.inf, -1.0], x_max=[np.inf, 1.0], terminal=None)
    return PlantTwin.fit(mpc, log(4), residuals=POLYNOMIALS)


def test_the_error_is_what_ninety_five_per_cent_of_the_steps_keep() -> None:
    twin = bounded()
    steps = [(x[:-1], u, x[1:]) for x, u in log(4)]
    model = twin.problem.model
    half = np.array([3.0, 3.0])
    errors = [np.abs(after - x @ model.A.T - u @ model.B.T) / half for x, u, after in steps]
    expected = np.quantile(np.concatenate(errors).max(axis=1), 0.95)
    assert one_step_error(twin.dynamics.row, twin.episodes) == pytest.approx(expected)


@pytest.mark.parametrize("given", [0.0, 0.3])
def test_an_accepted_policy_has_that_margin_unless_another_was_given(given: float) -> None:
    twin = bounded()
    options = {"problem": twin.problem, "bounds_margin": given}
    model = DDPG(YannPolicy, Cart(), device="cpu", seed=0, policy_kwargs=options)
    work = _Work(model.policy, 4, 1, 10, 0, _Progress(1))
    work.keep_margin(twin.dynamics.row, twin.episodes)
    work.accept(twin)
    error = one_step_error(twin.dynamics.row, twin.episodes)
    assert 1e-3 < error < 0.1
    assert model.policy.bounds_margin == pytest.approx(given or error)
    assert float(model.policy.actor_target.mu.margin) == model.policy.bounds_margin
