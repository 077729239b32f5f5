"""What a policy changes on the plant: intervals over all twins that a log does not refute."""

import copy
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import DDPG

from sample_plants import Sampled
from sb3_yann import LinearModel, LinearMPC, PlantTwin, Tracking, improve
from sb3_yann.evaluation import evaluate
from sb3_yann.twin import forecast as module
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.forecast import LAG, REMEMBERED, Actuator, Forecast
from sb3_yann.twin.trust import costs_of
from sb3_yann.wrappers import SetPoint
from sb3_yann_envs import ProblemBox
from twin_samples import POLYNOMIALS, problem
from twin_samples import twin as cart_twin

DT = 0.05
FRICTION = 2.4
TESTS = range(900, 930)
MPC = LinearMPC(
    LinearModel([[0.92]], [[0.25]], 1.0), Q=[[1]], R=[[0.08]], horizon=3,
    x_min=-2, x_max=2, u_min=-1, u_max=1,
)  # fmt: skip


class Lagging(Sampled):
    """A part of the gain behind a first-order actuator, and sensor noise."""

    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)
    starts = (-1.3, 1.3)
    steps = 40

    def __init__(self, lag: float, gain: float, noise: float = 0.006) -> None:
        self.lag = lag
        self.gain = gain
        self.noise = noise

    def shown(self):
        return self.x + self.noise * self.np_random.normal(size=1)

    def cost(self, u):
        return MPC.stage_cost(self.x, u)

    def moved(self, u):
        before = self.u if self.t else np.zeros(1)
        self.u = self.lag * before + (1 - self.lag) * u
        return 0.92 * self.x + 0.25 * self.gain * self.u


def twin(plant: Lagging, episodes: int = 6) -> PlantTwin:
    log = evaluate(MPC.explicit(), lambda: copy.copy(plant), range(100, 100 + episodes))
    return PlantTwin.fit(MPC, [*log.pairs], residuals=POLYNOMIALS)


@pytest.mark.parametrize("depth", [0, 2, 4])
def test_a_replay_with_the_mpc_costs_what_was_logged(depth: int) -> None:
    found = twin(Lagging(0.4, 0.5))
    first = np.stack([each.thetas[:1] for each in found.episodes])
    replays = module._Replays(found.judges[0], found.episodes, depth)
    logged = np.tile([costs_of(MPC, each) for each in found.episodes], (5, 1))
    np.testing.assert_allclose(replays.costs(law_of(MPC), first)[..., 0], logged, rtol=1e-9)


def test_the_mpc_itself_changes_nothing() -> None:
    change, low, high, _, worst, _ = cart_twin().forecast(law_of(problem()))
    assert change == low == high == worst == 0.0


def test_the_truth_lies_within_the_interval() -> None:
    plant = Lagging(0.0, 0.6)
    seeds = range(5000, 5200)
    found = twin(plant, 12)
    law = law_of(MPC)
    before = evaluate(MPC.explicit(), lambda: copy.copy(plant), seeds).costs
    for gain in (0.8, 1.1, 1.4):
        act = partial(lambda gain, x: np.clip(gain * law(x), -1, 1), gain)
        after = evaluate(lambda x, act=act: act(x[None])[0], lambda: copy.copy(plant), seeds).costs
        _, low, high, *_ = found.forecast(act)
        assert low <= after.sum() / before.sum() - 1 <= high and high - low < 0.2


@pytest.mark.parametrize(("levels", "sure"), [((0.4, 0.4), True), ((-0.4, 0.4), False)])
def test_new_set_points_lie_between_those_of_the_log(levels: tuple[float, float], sure) -> None:
    mpc = LinearMPC(MPC.model, Q=[[1]], R=[[0.08]], horizon=3, u_min=-1, u_max=1,
                    theta_min=-2, theta_max=2, tracking=Tracking([0], -0.5, 0.5))  # fmt: skip
    log = []
    for r in levels:
        env = TimeLimit(SetPoint(Lagging(0.0, 1.0), r, r), 30)
        log += evaluate(mpc.law(), lambda env=env: copy.deepcopy(env), range(3)).pairs

    def act(theta: np.ndarray) -> np.ndarray:
        return law_of(mpc)(theta) + 0.5 * (np.abs(theta[:, 1:]) < 0.3)

    _, low, high, _, worst, objection = PlantTwin.fit(mpc, log, residuals=POLYNOMIALS).forecast(act)
    assert low == 0 and (high == 0) == (worst == 0) == (not objection) == sure


def test_of_few_episodes_it_is_not_said_how_much_is_surely_gained(monkeypatch) -> None:
    monkeypatch.setattr(module, "law_of", lambda mpc: lambda x: 0.6 * law_of(mpc)(x))
    few, five = (
        twin(Lagging(0.0, 1.5, noise=0.0), count).forecast(law_of(MPC)).high for count in (4, 5)
    )
    assert few == -1e-9 and five < -0.01


def test_what_new_starts_lose_is_said_without_their_numbers() -> None:
    mpc = np.ones((5, 100))
    assert module._objection(mpc, mpc - 0.01) == ""
    policy = np.where(np.arange(100) < 5, 1.04, 0.99 * mpc)
    assert "4 % of the median cost more on average, 1 %" in module._objection(mpc, policy)
    policy[0, 0] = 3.0
    assert module._objection(mpc, policy) == "one costs far more than with the MPC"


def test_a_gain_in_one_of_five_episodes_is_sure_where_others_lose_little() -> None:
    for more, sure in (([-0.3, -0.03, 0, 0, 1e-3], True), ([-0.3, 0.03, 0.1, 0.1, 1e-3], False)):
        mean, low, high = module._changed(np.ones((5, 5)), 1 + np.array([more] * 5), 5, [])
        assert (high < 0) == sure and min(more) < low < mean < high < max(more)
    for dearer, sure in ((1, True), (12, False)):  # of two, new starts tell how much they vary
        more = np.r_[np.full(dearer, 0.3), np.linspace(-0.3, -0.1, 60 - dearer)]
        runs = np.ones((2, 60)), 1 + np.array([more, more])
        mean, _, high = module._changed(np.ones((2, 2)), np.full((2, 2), 0.8), 2, runs)
        assert np.isclose(mean, -0.2) and (high < 0) == sure
    narrow = module._changed(np.ones((2, 2)), np.full((2, 2), 0.98), 2, [np.ones((2, 9))] * 2)
    assert narrow == pytest.approx((-0.02, -0.021, -0.019))  # fits to two episodes err alike


def test_an_actuator_that_lags_shows_in_earlier_inputs() -> None:
    found = twin(Lagging(0.5, 1.0, noise=0.0))
    plain, memory = (module._Replays(found.judges[0], found.episodes, depth) for depth in (0, 2))
    assert memory.unexplained < 0.5 and np.mean(memory.errors**2) < 0.5 * np.mean(plain.errors**2)
    assert found.judges[-1].actuator == (LAG, 0.5) and "a lag with a pole of" in found.report()


def test_behind_noisy_sensors_alone_free_runs_tell_gains_and_nothing_is_remembered() -> None:
    lagging, noisy = twin(Lagging(0.5, 1.0)), twin(Lagging(0.0, 1.0, noise=0.03))
    behind, own, *others = (
        module._Replays(judge, found.episodes, 0)
        for found, judges in ((lagging, lagging.judges[:1]), (noisy, noisy.judges))
        for judge in judges
    )
    assert own.noise_alone and not behind.noise_alone and len(others) == 2
    for free in (False, True):
        assert all(module.surely_worse(each.left(free) - own.left(free)) == free for each in others)


@pytest.mark.parametrize("load", [0.0, 0.03])
def test_noise_of_sensors_is_told_from_a_load_where_states_drive_each_other(load: float) -> None:
    model = LinearModel([[0.2, -0.4], [0.6, 0.9]], [[0], [0.3]], 1.0)
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=2, x_min=-4, x_max=4, u_min=-1, u_max=1)
    rng = np.random.default_rng(0)
    log = []
    for _ in range(20):
        x, pushed = [rng.uniform(-1, 1, 2)], 0.0
        u = np.repeat(rng.uniform(-1, 1, (12, 1)), 5, axis=0)
        for each in u:
            x.append(model.A @ x[-1] + model.B @ (each + pushed))
            pushed = 0.95 * pushed + load * rng.normal()
        log.append((x + 0.01 * rng.normal(size=(61, 2)), u))
    found = PlantTwin.fit(mpc, log, residuals=["none"])
    assert module._Replays(found.judges[0], found.episodes, 0).noise_alone == (load == 0)


def test_an_actuator_lags_moves_so_far_or_has_a_play() -> None:
    for *each, a, b in (LAG, 0.5, 0.5, 0.25), ("rate limit", 0.2, 0.2, 0), ("play", 0.1, 0.9, 0.1):
        assert Actuator(*each).behind(np.array([0.0, 1, 0]), 1.0) == pytest.approx([0, a, b])


def test_where_it_may_cost_more_it_is_said_what_would_settle_it() -> None:
    found = twin(Lagging(0.5, 0.4))
    _, low, high, cure, *_ = found.forecast(lambda x: np.clip(1.05 * law_of(MPC)(x), -1, 1))
    assert low < 0 < high and ("held steps of u[0]" in cure or "episodes more" in cure)
    said = module._cure(0.01, -0.01, 0.02, REMEMBERED, 9, "u[0]", str)
    assert said.startswith("log held steps of u[0] for longer than the actuator takes, and any")
    assert said.endswith("perhaps because of a lag or a load that lasts, the change is -1 to +2 %")


def test_more_rows_of_the_mpc_alone_are_no_advice(monkeypatch) -> None:
    found = twin(Lagging(0.0, 0.6))
    assert found.trust.excitation[0] < 0.02  # the input follows the MPC
    unsure = Forecast(-0.01, -0.03, 0.01, "log about 5 episodes more")
    monkeypatch.setattr("sb3_yann.twin.plant_twin.forecast", lambda *_: unsure)
    cure = "log held steps of u[0]: its gain rests on the given B"
    assert found.forecast(law_of(MPC)) == unsure._replace(cure=cure)


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "gain"), [(0.4, 0.4), (0.3, 0.5)])
def test_a_twin_that_knows_no_lag_promises_what_the_plant_keeps(lag: float, gain: float) -> None:
    plant = Lagging(lag, gain)
    fitted = twin(plant)
    assert fitted.trusted
    model = DDPG("YannPolicy", fitted.env(), policy_kwargs={"problem": MPC}, device="cpu", seed=1)
    if improve(model, fitted, updates=1000, seed=1).accepted:
        seeds = range(5000, 5100)
        ours = evaluate(model, lambda: copy.copy(plant), seeds).costs
        assert ours.mean() < evaluate(MPC.explicit(), lambda: copy.copy(plant), seeds).costs.mean()


def motor() -> LinearMPC:
    """A motor's angle and speed; the model knows no dry friction."""
    model = LinearModel.from_continuous([[0, 1], [0, -1.5]], [[0], [2.0]], dt=DT)
    return LinearMPC(
        model, Q=np.diag([1, 0.02]), R=[[0.005]], horizon=5,
        x_min=[-6, -18], x_max=[6, 18], u_min=-12, u_max=12,
    )  # fmt: skip


class Motor(Sampled):
    """The motor with dry friction. Its MPC's input is on a bound but near the target."""

    action_space = gym.spaces.Box(-12, 12, (1,), np.float32)
    starts = ([-3, -5], [3, 5])
    steps = 100

    def __init__(self, mpc: LinearMPC) -> None:
        self.mpc = mpc
        box = np.float32([mpc.theta_min, mpc.theta_max])
        self.observation_space = ProblemBox(*box, problem=mpc)

    def cost(self, u):
        return self.mpc.stage_cost(self.x, u)

    def moved(self, u):
        place, speed = self.x
        for _ in range(10):
            drive = 2.0 * float(u[0]) - 1.5 * speed
            if abs(speed) < 1e-3 and abs(drive) <= FRICTION:
                speed = 0.0
            else:
                way = np.sign(speed if abs(speed) >= 1e-3 else drive)
                after = speed + DT / 10 * (drive - FRICTION * way)
                speed = 0.0 if speed * after < 0 else after
            place += DT / 10 * speed
        return np.array([place, speed])


@pytest.mark.nightly
def test_what_no_polynomial_knows_is_gained_with_networks(monkeypatch) -> None:
    monkeypatch.undo()  # networks too
    mpc = motor()
    make = partial(Motor, mpc)
    logged = evaluate(mpc.law(), make, range(100, 130)).pairs
    before = evaluate(mpc.law(), make, TESTS).costs
    for kinds in (("none", "linear", "quadratic"), ("none", "network")):
        twin = PlantTwin.fit(mpc, logged, residuals=kinds, updates=1500)
        assert twin.trusted
        model = DDPG("YannPolicy", Motor(mpc), device="cpu", seed=0)
        found = improve(model, twin, n_starts=10, rounds=2, updates=1500)
        assert found.accepted == ("network" in kinds)
    costs = evaluate(model, make, TESTS).costs
    assert costs.mean() < 0.99 * before.mean() and np.all(costs < before)
    assert costs.mean() / before.mean() - 1 == pytest.approx(found.change, abs=0.02)
