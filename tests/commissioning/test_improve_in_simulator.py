"""A policy that is improved in a simulator is better there, or stays what it was."""

from __future__ import annotations

import copy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG, TD3

from sb3_yann import LinearMPC, Tracking, YannPolicy, improve, offset_free
from sb3_yann.audit.closed_loops import Planning, of_law
from sb3_yann.audit.plants import SimulatedResidual
from sb3_yann.commissioning import critic, grounds, imitation, simulator_grounds
from sb3_yann.commissioning.improve import Improvement
from sb3_yann.commissioning.search import Pace, Search
from sb3_yann.commissioning.simulator_grounds import FinalTrial, SimulatedTrial, SimulatorGrounds
from sb3_yann.commissioning.simulator_twin import SimulatorTwin
from sb3_yann.commissioning.trial import Check
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.gradient import actor
from sb3_yann.wrappers import ObserveDisturbance, SetPoint
from twin_samples import DT, Cart, problem
from weights import is_mpc

FEW = {"iterations": 20, "n_starts": 12, "batch": 20}


class Movable(Cart):
    """A cart between springs, which its model does not know; it can be put into a state."""

    stiffness = 0.2

    def __init__(self, steps: int = 40) -> None:
        super().__init__(steps)

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        if options:
            self.x = np.array(options["state"], float)
        return self._seen(found)

    def step(self, action):
        u = np.clip(np.asarray(action, float), -1, 1)
        cost = float(problem().stage_cost(self.x, u))
        place, speed = self.x
        pull = self.stiffness * place + 0.2 * place**2 + 0.3 * place**3
        self.x = np.array([place + DT * speed, 0.9 * speed + DT * (2.0 * u[0] - pull)])
        self.t += 1
        return self._seen((self.x.astype(np.float32), -cost, False, self.t >= self.length, {}))

    def _seen(self, found):
        *rest, info = found
        return *rest, {**info, "state": self.x.copy()}


class Deaf(Movable):
    """The same, which no reset puts into a state."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)

    def _seen(self, found):
        return found


class Stiff(Movable):
    """Rests beside its set-points under the MPC."""

    stiffness = 0.8


class Limited(Movable):
    """Says that one must not go farther than 0.2 to the right of the middle."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "violation": bool(self.x[0] > 0.2)}


class Plain(Movable):
    """The cart as its model has it."""

    def step(self, action):
        u = np.clip(np.asarray(action, float), -1, 1)
        cost = float(problem().stage_cost(self.x, u))
        self.x = problem().predict(self.x, u)
        self.t += 1
        return self._seen((self.x.astype(np.float32), -cost, False, self.t >= self.length, {}))


def model_of(make=Movable, kind=DDPG, **policy_kwargs) -> DDPG:
    return kind(YannPolicy, make(), device="cpu", seed=0, policy_kwargs=policy_kwargs)


def bits(model) -> dict[str, bytes]:
    state = model.policy.state_dict()
    return {name: each.cpu().numpy().tobytes() for name, each in state.items()}


UNSEEN = range(900, 940)
MPC_COST = evaluate(problem().explicit(), Movable, UNSEEN).costs


@pytest.fixture(autouse=True)
def brisk(monkeypatch, request) -> None:
    """Let fits and critics be short, but where a test asks for the defaults."""
    if "thorough" in request.fixturenames:
        return
    monkeypatch.setattr(imitation, "UPDATES", 500)
    monkeypatch.setattr(imitation, "ROUNDS", 2)
    monkeypatch.setattr(imitation, "FINAL", 1)
    monkeypatch.setattr(simulator_grounds, "FINAL", 1)
    monkeypatch.setattr(grounds, "POOL", 60)
    monkeypatch.setattr(critic, "SAMPLES", 256)
    monkeypatch.setattr(critic, "STEPS", 30)


@pytest.fixture
def thorough() -> None:
    """Leave the defaults."""


def relative(model) -> np.ndarray:
    """Return what unseen episodes cost, relative to the MPC."""
    return evaluate(model, Movable, UNSEEN).costs / MPC_COST


@pytest.mark.slow
def test_with_the_defaults_no_start_is_dearer(thorough) -> None:
    model = model_of()
    found = improve(model, Movable)
    assert found.accepted
    assert relative(model).mean() < 0.97 and relative(model).max() < 1.0


@pytest.mark.parametrize("kind", [DDPG, TD3])
def test_a_policy_gains_on_starts_that_it_has_not_seen(kind, tmp_path) -> None:
    model = model_of(kind=kind)
    found = improve(model, Movable, **FEW)
    assert found.accepted and found.where == "the simulator"
    assert "of the MPC's stage cost in the simulator" in str(found)
    assert relative(model).mean() < 0.98 and relative(model).max() < 1.005
    target, own = model.actor_target.state_dict(), model.actor.state_dict()
    assert all(th.equal(target[name], each) for name, each in own.items())
    model.save(tmp_path / "model")
    again = kind.load(tmp_path / "model", device="cpu")
    theta = np.float32([0.5, -0.2])
    np.testing.assert_array_equal(again.predict(theta)[0], model.predict(theta)[0])


@pytest.mark.slow
def test_what_cannot_be_put_into_a_state_has_a_twin_of_its_episodes() -> None:
    model = model_of(Deaf)
    assert improve(model, Deaf, **FEW).accepted
    assert relative(model).mean() < 0.97


def test_where_there_is_nothing_to_gain_the_model_stays_as_it_was() -> None:
    model = model_of(Plain)
    before = bits(model)
    found = improve(model, Plain, **FEW)
    assert not found.accepted
    assert "The model is as it was" in found.report()
    assert bits(model) == before


@pytest.mark.parametrize("share", [0.3, -0.3])
def test_whatever_plans_teach_nothing_worse_is_accepted(monkeypatch, share) -> None:
    def wrong(layer, problem, rows, inputs, rng, updates):
        for each in layer.network.weights():
            with th.no_grad():
                each.add_(share)

    monkeypatch.setattr(imitation, "fit_layer", wrong)
    model = model_of()
    improve(model, Movable, **FEW)
    assert relative(model).mean() <= 1.0 and relative(model).max() < 1.1


def test_plans_that_lose_to_the_mpc_teach_nothing(monkeypatch) -> None:
    begins = np.array([0, 0, 7])
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 4, 0)
    teacher = imitation.Teacher(grounds, 0)
    assert teacher.show(range(3), begins, problem().law()) > 0
    rows = 40 + 40 + 33
    assert len(teacher.thetas) == len(teacher.inputs) == (1 + imitation.NEARBY) * rows

    class Wrong(Planning):
        def __call__(self, t, theta, rows):
            return 0 * super().__call__(t, theta, rows) + 0.8

    monkeypatch.setattr(imitation, "Planning", Wrong)
    teacher = imitation.Teacher(grounds, 0)
    assert teacher.show(range(3), begins, problem().law()) == 0.0
    assert not teacher.thetas
    layer = copy.deepcopy(model_of().policy.actor.mu)
    before = copy.deepcopy(layer.state_dict())
    assert [*imitation.imitate(layer, grounds, 0)] == []
    assert all(th.equal(before[name], each) for name, each in layer.state_dict().items())


def test_the_fit_that_loses_the_fewest_is_kept(monkeypatch) -> None:
    lost = iter([([(1, 40)] * n, 0.01 * n) for n in (3, 1, 2, 2)])
    monkeypatch.setattr(imitation, "_lost", lambda grounds, act: next(lost))
    monkeypatch.setattr(imitation, "ROUNDS", 9)
    monkeypatch.setattr(imitation, "PATIENCE", 2)
    fits = []

    def mark(layer, problem, rows, inputs, rng, updates):
        fits.append(len(rows))
        with th.no_grad():
            layer.network.weights()[-1].fill_(len(fits))

    monkeypatch.setattr(imitation, "fit_layer", mark)
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 4, 0)
    layer = copy.deepcopy(model_of().policy.actor.mu)
    assert [*imitation.imitate(layer, grounds, 0)] == [0, 1, 2, 3]
    assert fits == sorted(set(fits))  # each has learnt more
    assert (layer.network.weights()[-1] == 2).all()


def test_a_violation_more_is_refused() -> None:
    model = model_of(Limited)
    improve(model, Limited, **FEW)
    seeds = range(700, 720)
    ours, mpc = (evaluate(each, Limited, seeds) for each in (model, problem().explicit()))
    assert np.all(ours.violations <= mpc.violations)
    twin = SimulatorTwin.of(problem(), Limited)
    trial = SimulatedTrial(twin, range(10))
    unsafe = trial.mpc[1].copy()
    unsafe[3, 0] += 1
    check = trial.check(5, (0.5 * trial.mpc[0], unsafe), trial.mpc)
    assert not check.accepted and not check.safe
    assert "1 starts with violations, the first is number 3" in check.reason


class Rarely(Movable):
    """In few episodes, of which no check has one, whoever leaves the MPC breaks a limit."""

    rare = range(0)

    def reset(self, *, seed=None, options=None):
        self.bad = seed in self.rare
        return super().reset(seed=seed, options=options)

    def step(self, action):
        theta = self.x.astype(np.float32).astype(float)
        left = np.abs(problem().explicit()(theta) - action).max() > 1e-3
        *rest, info = super().step(action)
        return *rest, {**info, "violation": bool(self.bad and left)}


def test_a_loss_that_no_check_meets_is_met_in_the_final_trial(monkeypatch) -> None:
    drawn = []
    draw = SimulatorGrounds.draw_final

    def noted(self):
        drawn.append(self.next_seed)
        Rarely.rare = range(self.next_seed, self.next_seed + 1)
        return draw(self)

    monkeypatch.setattr(SimulatorGrounds, "draw_final", noted)
    model = model_of()
    before = bits(model)
    found = improve(model, Rarely, **FEW)
    assert drawn and not found.accepted
    assert bits(model) == before
    assert any(each.accepted for each in found.checks if not each.final)
    assert [each.final for each in found.checks][-3:] == [True] * 3  # all of it, half, a quarter
    assert not any(each.final for each in found.checks[:-4])
    assert "in the final trial, 1 starts with violations" in str(found)
    assert found.change == 0.0


@pytest.mark.parametrize("most", [1.0, 0.5, 0.25, 0.1])
def test_what_the_final_trial_refuses_is_halved(monkeypatch, most) -> None:
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 12, 0)
    search = Search(model_of().policy.actor.mu, grounds, Pace(20, 5e-3, 20, 5))
    assert [*search.steps(20)][-1] == 20 and search.gains(0.001)
    whole = copy.deepcopy(search.accepted)
    law, theta = problem().law(), np.array([[0.5, -0.2]])

    def correction(weights):
        search.layer.load_state_dict(weights)
        return actor(search.layer, problem())(theta) - law(theta)

    limit = 1.05 * most * np.abs(correction(whole))

    class Strict(FinalTrial):
        def play(self, act):
            costs, unsafe = super().play(act)
            unsafe[0, 0] += int(np.any(np.abs(act(theta) - law(theta)) > limit))
            return costs, unsafe

    monkeypatch.setattr(grounds, "draw_final", lambda: Strict([grounds.draw(grounds.drawing)]))
    assert search.confirm(1e-6) == (most >= 0.25)
    assert search.gains(1e-6) == (most >= 0.25)
    if most >= 0.25:
        np.testing.assert_allclose(correction(search.accepted), most * correction(whole), rtol=1e-3)


def test_what_was_accepted_first_is_tried_before_a_part_of_the_way(monkeypatch) -> None:
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 12, 0)
    search = Search(model_of().policy.actor.mu, grounds, Pace(40, 5e-3, 20, 5))
    assert [*search.steps(20)][-1] == 20
    first = copy.deepcopy(search.accepted)
    assert [*search.steps(40)][-1] == 40
    assert all(each.accepted for each in search.checks) and len(search.checks) == 2
    theta = np.array([[0.5, -0.2]])
    search.layer.load_state_dict(first)
    wanted = actor(search.layer, problem())(theta)
    played = []

    class Strict(FinalTrial):
        def play(self, act):
            costs, unsafe = super().play(act)
            played.append(act(theta))
            unsafe[0, 0] += int(np.any(played[-1] != wanted))
            return costs, unsafe

    monkeypatch.setattr(grounds, "draw_final", lambda: Strict([grounds.draw(grounds.drawing)]))
    assert search.confirm(1e-6) and len(played) == 2
    assert all(np.array_equal(search.accepted[key], each) for key, each in first.items())


def test_a_final_trial_joins_its_episodes() -> None:
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 2, 0)
    first, second = (SimulatedTrial(grounds.twin, seeds) for seeds in (range(5), range(5, 9)))
    final, whole = FinalTrial([first, second]), SimulatedTrial(grounds.twin, range(9))
    for ours, theirs in zip(final.mpc, whole.mpc, strict=True):
        np.testing.assert_array_equal(ours, theirs)

    def act(theta):
        return 0.9 * problem().law()(theta)

    played = final.play(act)
    assert final.check(0, played, final.mpc) == whole.check(0, whole.play(act), whole.mpc)


def test_final_episodes_are_new_ones(monkeypatch) -> None:
    monkeypatch.setattr(simulator_grounds, "FINAL", 3)
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 2, 0)
    later = grounds.draw(grounds.drawing).seeds
    seeds = [seed for each in grounds.draw_final().blocks for seed in each.seeds]
    assert len(seeds) == len(set(seeds)) == 3 * 3 * 2 * 2
    assert min(seeds) > max(later) > max(grounds.trial.seeds) > max(grounds.twin.seeds)


def test_where_a_policy_loses_nothing_more_episodes_are_asked(monkeypatch) -> None:
    monkeypatch.setattr(imitation, "FINAL", 3)
    grounds = SimulatorGrounds(SimulatorTwin.of(problem(), Movable), 20, 2, 0)
    asked = []

    def lost(self, played):
        asked.append(len(self.seeds))
        return np.array([4, 1] if len(asked) == 4 else [], dtype=np.intp)

    monkeypatch.setattr(SimulatedTrial, "lost", lost)
    found, share = imitation._lost(grounds, problem().law())
    assert asked == [4, 12, 12, 12] and share == 2 / 40
    assert [seed - found[1][0] for seed, _ in found] == [3, 0]
    asked.extend([0] * 4)
    assert imitation._lost(grounds, problem().law()) == ([], 0.0)
    assert len(asked) == 8 + 5


def test_what_was_learnt_before_is_kept_or_bettered() -> None:
    model = model_of()
    first = improve(model, Movable, **FEW)
    before = relative(model).mean()
    second = improve(model, Movable, seed=1, **FEW)
    assert first.before is None and second.before is not None
    assert second.before.accepted
    assert relative(model).mean() <= before + 0.002


def test_two_runs_are_equal_bit_for_bit_and_no_random_numbers_are_drawn() -> None:
    both = []
    for _ in range(2):
        model = model_of()
        np.random.seed(3)  # noqa: NPY002
        th.manual_seed(3)
        improve(model, Movable, **(FEW | {"iterations": 5}))
        drawn = np.random.rand(), float(th.rand(1))  # noqa: NPY002
        both.append((bits(model), drawn))
    assert both[0] == both[1]
    np.random.seed(3)  # noqa: NPY002
    th.manual_seed(3)
    assert both[0][1] == (np.random.rand(), float(th.rand(1)))  # noqa: NPY002


def test_a_shared_network_and_a_bound_are_kept() -> None:
    model = model_of(networks="shared", max_correction=0.05)
    improve(model, Movable, **FEW)
    rng = np.random.default_rng(0)
    theta = rng.uniform(-2, 2, (50, 2)).astype(np.float32)
    apart = np.abs(model.predict(theta)[0] - problem().explicit()(theta))
    assert apart.max() <= 0.05 * 2 + 1e-6


def test_a_given_env_is_copied_and_left_where_it_is() -> None:
    env = Movable()
    env.reset(seed=5)
    x = env.x.copy()
    improve(model_of(), env, **(FEW | {"iterations": 2}))
    np.testing.assert_array_equal(env.x, x)
    assert env.t == 0


def test_the_gradient_goes_through_the_simulator_s_own_steps() -> None:
    twin = SimulatorTwin.of(problem(), Movable)
    rng = np.random.default_rng(1)
    theta, u = rng.uniform(-1, 1, (1, 20, 2)), rng.uniform(-0.9, 0.9, (1, 20, 1))
    after = twin.dynamics.step(theta, u)[0]
    env = Movable()
    for k in range(20):
        env.reset(options={"state": theta[0, k]})
        env.step(u[0, k].astype(np.float32))
        np.testing.assert_allclose(after[k], env.x, atol=1e-12)
    A, B = twin.dynamics.jacobians(theta, u)
    place = theta[0, :, 0]
    slope = 0.2 + 0.4 * place + 0.9 * place**2
    np.testing.assert_allclose(A[0, :, 1, 0], -0.1 * slope, atol=0.02)
    np.testing.assert_allclose(B[0, :, 1, 0], 0.2, atol=1e-4)


class Slippery(Movable):
    """Cannot go on from the far right: it says so, or shows NaN."""

    def step(self, action):
        if self.x[0] > 50:
            raise ValueError("off the track")
        if self.x[0] > 40:
            self.x = np.array([np.nan, np.nan])
        return super().step(action)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_where_a_simulator_cannot_go_on_its_twin_stays() -> None:
    twin = SimulatorTwin.of(problem(), Slippery)
    theta, u = np.array([[[60.0, 1.0], [45.0, 1.0]]]), np.zeros((1, 2, 1))
    np.testing.assert_allclose(twin.dynamics.step(theta, u), theta, atol=1e-12)


def tracking() -> LinearMPC:
    return LinearMPC(
        problem().model, Q=np.diag([1.0, 0.0]), R=[[0.1]], horizon=3, gamma=0.95,
        u_min=-1, u_max=1, theta_min=[-3, -3], theta_max=[3, 3], tracking=Tracking([0], -1, 1),
    )  # fmt: skip


def followed(hold: int = 20) -> gym.Env:
    return TimeLimit(SetPoint(Stiff(1000), -1, 1, hold=hold), 40)


def test_where_a_set_point_changes_in_a_lost_episode_is_hard() -> None:
    trial = SimulatorGrounds(SimulatorTwin.of(tracking(), followed), 10, 4, 0).trial
    costs, unsafe = trial.mpc
    worse = costs.copy()
    worse[2] += 10 * costs.max()
    (rows,) = trial.hard((worse, unsafe))
    assert len(rows) == 2  # the beginning, and the new set-point
    assert rows[0, 2] != rows[1, 2]


def test_set_points_are_followed_for_less() -> None:
    mpc, make = tracking(), partial(followed, hold=40)
    model = DDPG(YannPolicy, make(), gamma=0.95, device="cpu", policy_kwargs={"problem": mpc})
    assert improve(model, make, **FEW).accepted
    seeds, twin = range(800, 830), SimulatorTwin.of(mpc, make)
    ours, before = (
        twin.play(each, seeds).costs
        for each in (lambda t, x, _: actor(model.policy.actor.mu, mpc)(x), of_law(mpc))
    )
    assert np.mean(ours / before) < 0.97


@pytest.mark.slow
def test_an_observer_steps_with_the_simulator() -> None:
    mpc, observer = offset_free(tracking(), d_max=[0.5, 0.5])
    bounds = mpc.disturbances.d_min, mpc.disturbances.d_max

    def make() -> gym.Env:
        return ObserveDisturbance(followed(), observer, *bounds)

    twin = SimulatorTwin.of(mpc, make)
    assert isinstance(twin.dynamics.members[0], SimulatedResidual)
    one = twin.episodes[0]
    rows, given = one.thetas.copy(), twin.dynamics.row.given
    after = twin.dynamics.step(rows[None, :-1], one.actions[None])[0]
    other = np.setdiff1d(np.arange(rows.shape[1]), np.arange(given.start, given.stop))
    np.testing.assert_allclose(after[:, other], rows[1:, other], atol=1e-4)  # shown in float32


class Short(Movable):
    """Ends at once."""

    def __init__(self) -> None:
        super().__init__(steps=3)


class Strange(Movable):
    """Shows one value more."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Box(-3, 3, (3,), np.float32)


class Broken(Movable):
    """Shows NaN."""

    def step(self, action):
        self.t += 1
        return np.full(2, np.nan, np.float32), -1.0, False, self.t >= 9, {"state": self.x}


class Unseeded(Movable):
    """Draws its starts from elsewhere."""

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed, options=options)
        if options:
            return found
        self.x = np.random.default_rng().uniform(-1, 1, 2)
        return self.x.astype(np.float32), {"state": self.x.copy()}


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (Unseeded, r"the env does not repeat it.*wrap it in sb3_yann.wrappers.SeededGlobals"),
        (Short, r"None of 40 episodes of the MPC in the simulator has 5 steps that are all finite"),
        (Broken, r"None of 40 episodes of the MPC in the simulator has 5 steps that are all finit"),
        (Strange, r"The simulator shows \(3,\) and takes \(1,\); theta of the model's problem has"),
    ],
)
def test_a_simulator_that_will_not_do_is_named(make, what) -> None:
    model = model_of()
    before = bits(model)
    with pytest.raises(ValueError, match=what):
        improve(model, make, **FEW)
    assert bits(model) == before


def test_a_vector_env_is_no_simulator() -> None:
    with pytest.raises(TypeError, match="or a function that makes one"):
        improve(model_of(), [Movable(), Movable()])
    with pytest.raises(TypeError, match=r"made None. It must return a gymnasium.Env"):
        improve(model_of(), lambda: None)


class Rare(Movable):
    """Costs nothing that is finite from some starts."""

    def reset(self, *, seed=None, options=None):
        self.bad = seed is not None and seed % 4 == 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        shown, *rest = super().step(action)
        return (np.full(2, np.nan, np.float32) if self.bad else shown), *rest


def test_starts_where_the_mpc_s_own_cost_is_not_finite_are_left_out() -> None:
    twin = SimulatorTwin.of(problem(), Rare)
    trial = SimulatedTrial(twin, range(8))
    assert [*trial.seeds] == [1, 2, 3, 5, 6, 7]
    assert np.isfinite(trial.mpc[0]).all()
    with pytest.raises(ValueError, match="cost is finite in none of 2 episodes of the simulator"):
        SimulatedTrial(twin, [0, 4])


def test_a_few_dear_episodes_do_not_hide_that_all_others_gain() -> None:
    twin = SimulatorTwin.of(problem(), Movable)
    trial = SimulatedTrial(twin, range(30))
    trial.mpc = (np.where(np.arange(30) == 7, 1e4, 1.0), trial.mpc[1])
    check = trial.check(0, (0.5 * trial.mpc[0], trial.mpc[1]), trial.mpc)
    assert check.accepted and check.gains(0.001)
    assert check.logged == pytest.approx(-0.5)
    mixed = np.where(np.arange(30) % 2 == 0, 0.5, 1.4999) * trial.mpc[0]
    assert not trial.check(0, (mixed, trial.mpc[1]), trial.mpc).gains(0.001)


def test_envs_are_made_once_and_closed_in_the_end() -> None:
    made, closed = [], []

    class Counted(Movable):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)

        def close(self) -> None:
            closed.append(self)

    improve(model_of(), Counted, **(FEW | {"iterations": 2}))
    assert len(made) <= 78  # as many as confirm side by side, and a few to look at
    assert {id(each) for each in made} >= {id(each) for each in closed}
    assert len(closed) >= 40


def test_a_report_says_where_there_is_no_gain() -> None:
    check = Check(20, True, "", 0.0, 0.0, True, 0.0, 0.0)
    found = Improvement((check,), 0.0, False, where="the simulator")
    assert found.reason == "Nothing better was found: no gain in the simulator."
    small = (Check(20, True, "", -4e-4, 0.0, True, 0.0, 0.0), Check(40, False, "no", 0.0, 0, True))
    assert "a gain of 0.04 % in the simulator is too small" in str(
        Improvement(small, 0.0, False, where="the simulator")
    )


def test_a_report_says_what_an_episode_gains() -> None:
    check = Check(20, True, "", -0.5, 0.002, True, -0.3, 0.01)
    assert Improvement((check,), -0.5, True, where="the simulator").report() == (
        "Accepted: -50.00 % of the MPC's stage cost in the simulator, -30.00 % (± 1.00) of an "
        "episode's own on average, +0.20 % from the worst start. 1 of 1 checks passed."
    )


def test_a_fresh_model_is_untouched_by_a_failed_refit(monkeypatch) -> None:
    import importlib

    module = importlib.import_module("sb3_yann.commissioning.improve")

    def fails(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr(module, "refit_critic", fails)
    model = model_of()
    with pytest.raises(RuntimeError, match="no memory"):
        improve(model, Movable, **FEW)
    assert is_mpc(model)


def test_a_copy_of_a_model_is_not_shared() -> None:
    model = model_of()
    other = copy.deepcopy(model.policy)
    improve(model, Movable, **(FEW | {"iterations": 2}))
    assert other.actor.mu.network.is_zero()
