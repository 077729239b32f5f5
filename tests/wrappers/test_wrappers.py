"""Wrappers that complete an observation to theta: what they append, and when."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import DDPG

from general_problems import servo
from sample_plants import LinearPlant, Sampled, two_input_mpc
from sb3_yann import (
    AffineObservation,
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    NonFiniteWarning,
    RateLimits,
    Tracking,
    offset_free,
)
from sb3_yann.control import StateEstimator
from sb3_yann.improvement.simulator import in_deviations
from sb3_yann.wrappers import (
    EstimateState,
    MeasuredDisturbance,
    ObserveDisturbance,
    PastInputs,
    PreviousInput,
    SetPoint,
    StageCost,
)


class Counter(gym.Env):
    """Observes the number of steps, twice; reports a disturbance."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0, 100, (2,), np.float32)
        self.action_space = gym.spaces.Box(np.float32([-1]), np.float32([2]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {"disturbance": 0.0}

    def step(self, action):
        self.steps += 1
        info = {"disturbance": 0.1 * self.steps, "violation": self.steps == 2}
        return np.full(2, self.steps, np.float32), -7.0, False, False, info


def test_the_previous_input_is_the_one_that_was_played(monkeypatch) -> None:
    own = Counter.step
    writes = lambda self, action: (own(self, action), action.fill(0.25))[0]  # noqa: E731
    monkeypatch.setattr(Counter, "step", writes)
    env = PreviousInput(Counter(), initial=[0.5])
    assert env.reset()[0].tolist() == [0, 0, 0.5]
    assert env.step(np.array([1.5]))[0].tolist() == [1, 1, 1.5]
    assert env.step(np.array([9.0]))[0].tolist() == [2, 2, 2]  # clipped to the action space
    assert env.reset()[0].tolist() == [0, 0, 0.5]
    assert env.observation_space.low.tolist() == [0, 0, -1]
    assert env.observation_space.high.tolist() == [100, 100, 2]


def test_a_reference_is_drawn_for_each_episode_and_follows_the_seed() -> None:
    env = SetPoint(Counter(), [-1, 0], [1, 5])
    first, _ = env.reset(seed=3)
    assert env.step(np.zeros(1))[0][2:].tolist() == first[2:].tolist()
    second, _ = env.reset()
    assert second[2:].tolist() != first[2:].tolist()
    assert env.reset(seed=3)[0].tolist() == first.tolist()
    for _ in range(50):
        assert env.observation_space.contains(env.reset()[0])


def test_a_reference_follows_the_seed_where_the_env_does_not_seed_its_generator() -> None:
    class Unseeded(Counter):
        def reset(self, *, seed=None, options=None):
            return super().reset()

    def references(seed):
        env = SetPoint(Unseeded(), [-1], [1], hold=1)
        return [env.reset(seed=seed)[0][2], env.step(np.zeros(1))[0][2], env.reset()[0][2]]

    assert references(3) == references(3) != references(4)
    assert len(set(references(3))) == 3


def test_a_reference_of_an_env_that_seeds_is_drawn_from_its_generator() -> None:
    drawn = np.random.default_rng(np.random.PCG64(np.random.SeedSequence(3))).uniform(-1, 1)
    assert SetPoint(Counter(), [-1], [1]).reset(seed=3)[0][2] == np.float32(drawn)


def test_a_reference_may_change_every_few_steps() -> None:
    env = SetPoint(Counter(), [-1], [1], hold=2)
    seen = [env.reset(seed=0)[0][2], *(env.step(np.zeros(1))[0][2] for _ in range(5))]
    assert seen[::2] == seen[1::2]
    assert len(set(seen)) == 3


def test_references_one_after_another_are_a_schedule_whose_last_one_stays() -> None:
    env = SetPoint(Counter(), [0], [9], schedule=[3, 1, 4], preview=2)
    assert env.reset()[0][2:].tolist() == [3, 1, 4]
    assert env.step(np.zeros(1))[0][2:].tolist() == [1, 4, 4]
    with pytest.raises(ValueError, match=r"would be ignored. .* schedule=\[r\]"):
        env.reset(options={"set_point": [3]})
    ends = SetPoint(Counter(), [0], [9], schedule=[3, 1, 4].__getitem__, preview=2)
    ends.reset()
    with pytest.raises(ValueError, match=r"schedule\(3\) ends in .* pass the sequence itself"):
        ends.step(np.zeros(1))


def test_the_last_disturbance_that_is_known_stays() -> None:
    class Record(Counter):
        """Reports what is left of a record."""

        def reset(self, **kwargs):
            self.left = [[1.0], [2.0], [3.0]]
            return super().reset(**kwargs)[0], {"disturbance": self.left}

        def step(self, action):
            self.left = self.left[1:]
            return *super().step(action)[:4], {"disturbance": self.left}

    env = MeasuredDisturbance(Record(), 0, 9, preview=2)
    assert env.reset()[0][2:].tolist() == [1, 2, 3]
    assert env.step(np.zeros(1))[0][2:].tolist() == [2, 3, 3]
    assert env.step(np.zeros(1))[0][2:].tolist() == [3, 3, 3]
    with pytest.raises(ValueError, match=r"shape \(0,\), expected \(3, 1\)"):
        env.step(np.zeros(1))
    with pytest.raises(ValueError, match=r"shape \(3, 1\), expected \(5, 1\), a row for this"):
        MeasuredDisturbance(Record(), 0, 9, preview=4).reset()


def test_the_estimate_takes_the_place_of_the_measurement() -> None:
    model = LinearModel(np.diag([0.9, 0.8, 0.7]), np.ones((3, 1)), 1.0, E=[[1], [0], [0]])
    observer = DisturbanceObserver(model, [0, 2])
    env = ObserveDisturbance(SetPoint(Counter(), [4], [4]), observer, [-0.5], [0.5])
    assert env.observation_space.shape == (5,)
    assert env.reset()[0].tolist() == [0, 0, 0, 4, 0]
    shown = env.step(np.array([0.5]))[0]
    x_hat, d_hat = observer.update([1, 1], [0.5])  # the wrapper has a copy of its own
    np.testing.assert_allclose(shown, [*x_hat, 4, *np.clip(d_hat, -0.5, 0.5)], rtol=1e-6)
    for _ in range(20):
        shown = env.step(np.array([0.5]))[0]
    assert shown[-1] == 0.5 == env.observer.d_hat[0]  # as x_hat has it


def test_an_input_that_moves_faster_than_its_bounds_is_a_violation() -> None:
    mpc = servo(tracking=None, rate=RateLimits(-0.5, 0.7))
    env = StageCost(PreviousInput(LinearPlant(servo(tracking=None))), mpc)
    env.reset(seed=0)
    reported = [env.step(np.float32([u]))[4].get("violation", False) for u in (0.7, 0.2, 1, -1)]
    assert reported == [False, False, True, True]
    with pytest.raises(ValueError, match=r"sees inputs from -1 to 1, .*RescaleAction"):
        StageCost(PreviousInput(LinearPlant(servo(tracking=None, u_min=-1, u_max=1))), mpc)


def test_a_violation_may_cost_extra() -> None:
    mpc = LinearMPC(LinearModel(np.eye(2) / 2, np.ones((2, 1)), 1), Q=np.eye(2), R=[[1]], horizon=1)
    env = StageCost(Counter(), mpc, violation_cost=1000)
    env.reset()
    assert env.step(np.zeros(1))[1] == 0
    assert env.step(np.zeros(1))[1] == pytest.approx(-1002)


@pytest.mark.parametrize(
    "wrap",
    [
        PreviousInput,
        lambda env: SetPoint(env, [-1], [1]),
        lambda env: MeasuredDisturbance(env, [0], [5]),
    ],
)
@pytest.mark.filterwarnings("ignore:.*")  # the checker recommends actions in [-1, 1]
def test_gymnasium_s_checker_finds_nothing_wrong(wrap) -> None:
    check_env(wrap(Counter()), skip_render_check=True)


DICT = gym.spaces.Dict({"a": gym.spaces.Discrete(2)})


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: SetPoint(Counter(), [1], [0]), ValueError, "no entry of low may exceed"),
        (lambda: SetPoint(Counter(), [1], [0, 2]), ValueError, r"low has shape \(1,\) and high"),
        (lambda: SetPoint(Counter(), [0], [np.inf]), ValueError, "must be finite"),
        (lambda: SetPoint(Counter(), [0], [1], hold=0), ValueError, "hold = 0 must be"),
        (lambda: SetPoint(Counter(), [0], [1], schedule=[2]), ValueError, r"\[2.0\] must have"),
        (
            lambda: MeasuredDisturbance(Counter(), [0], [1], key="load").reset(),
            ValueError,
            "info has no 'load', only",
        ),
        (
            lambda: MeasuredDisturbance(Counter(), [0, 0], [1, 1]).reset(),
            ValueError,
            r"info\['disturbance'\] has shape \(1,\), expected \(2,\)",
        ),
        (
            lambda: PreviousInput(Counter(), initial=[1, 2]),
            ValueError,
            r"initial has shape \(2,\), expected \(1,\)",
        ),
        (lambda: PreviousInput(Counter(), initial=[4]), ValueError, r"= \[4.0\] is not between"),
        (lambda: ObserveDisturbance(Counter(), 3, [0], [1]), TypeError, "observer = 3 must be"),
        (
            lambda: StageCost(Counter(), two_input_mpc()),
            ValueError,
            r"shape \(2,\), but theta = \[x\[0\], x\[1\], x\[2\]\] has 3 entries",
        ),
    ],
)
def test_bad_arguments_are_named(make, error, message) -> None:
    with pytest.raises(error, match=message):
        make()


def test_an_env_whose_observation_is_no_vector_is_named() -> None:
    env = Counter()
    env.observation_space = DICT
    with pytest.raises(TypeError, match=r"observation_space is Dict.*Box with one dimension"):
        SetPoint(env, [0], [1])


def test_a_disturbance_that_is_not_finite_is_named_once_and_the_last_one_holds() -> None:
    class Fails(gym.Wrapper):
        def step(self, action):
            *rest, info = self.env.step(action)
            if self.unwrapped.steps in (2, 3):
                info["disturbance"] = np.nan
            return *rest, info

    env = MeasuredDisturbance(Fails(Counter()), -1, 1)
    env.reset()
    assert env.step(np.zeros(1))[0][2] == np.float32(0.1)
    with pytest.warns(NonFiniteWarning, match=r"info\['disturbance'\] = \[nan\] is not finite"):
        assert env.step(np.zeros(1))[0][2] == np.float32(0.1)
    assert env.step(np.zeros(1))[0][2] == np.float32(0.1)
    assert env.step(np.zeros(1))[0][2] == np.float32(0.4)


def test_a_measurement_that_is_not_finite_is_named_and_predicted() -> None:
    class Fails(gym.Wrapper):
        def step(self, action):
            observation, *rest = self.env.step(action)
            return observation * (np.nan if self.unwrapped.steps == 2 else 1), *rest

    model = LinearModel(np.eye(2) / 2, [[1.0], [0.0]], dt=1, E=np.eye(2))
    env = ObserveDisturbance(Fails(Counter()), DisturbanceObserver(model), [-1, -1], [1, 1])
    env.reset()
    env.step(np.zeros(1))
    before = env.observer.estimate.copy()
    with pytest.warns(NonFiniteWarning, match=r"\[nan, nan\] is not finite"):
        observation = env.step(np.zeros(1))[0]
    np.testing.assert_allclose(env.observer.estimate, env.observer.A @ before)
    assert np.all(np.isfinite(observation))


def test_an_estimate_that_stays_beyond_its_range_is_told_once() -> None:
    model = LinearModel(np.eye(2) / 2, [[1.0], [0.0]], dt=1, E=np.eye(2))
    env = ObserveDisturbance(Counter(), DisturbanceObserver(model), [-0.5, -99], [0.5, 99])
    env.reset()
    with pytest.warns(UserWarning, match=r"d\[0\] .* -0.5 to 0.5: .*d_max=") as found:
        [env.step(np.zeros(1)) for _ in range(150)]
    assert len(found) == 1


def test_inputs_on_their_way_are_shown_newest_first() -> None:
    env = PastInputs(gym.make("CSTR-v0"), [3], initial=[0.5])
    assert env.reset(seed=0)[0][4:].tolist() == [0.5, 0.5, 0.5]
    env.step(np.float32([1]))
    assert env.step(np.float32([-1]))[0][4:].tolist() == [-1, 1, 0.5]
    assert env.reset(seed=0)[0][4:].tolist() == [0.5, 0.5, 0.5]
    assert env.observation_space.shape == (7,)


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_lies_on_a_bound_stays_inside_when_it_is_rounded(sign) -> None:
    """float32 has no 0.3 but one beyond it, where this law would be zero."""
    law = servo(infeasible="zero_input", tracking=Tracking([0], -0.3, 0.3)).explicit()
    env = SetPoint(Counter(), -0.3, 0.3, schedule=lambda step: 0.3 * sign)
    for shown in (env.reset()[0], env.step(np.zeros(1))[0]):
        assert 0.299999 < sign * float(shown[2]) <= 0.3
        assert sign * law([0, 0, shown[2]])[0] > 0.01


class Loaded(Sampled):
    """A tank with a gain that its model does not know, a load that it reports, and a leak."""

    observation_space = gym.spaces.Box(-50, 50, (1,), np.float64)
    action_space = gym.spaces.Box(-30, 30, (1,), np.float64)
    starts = (0.0, 0.0)

    def load(self) -> float:
        return 2.0 if self.t < 60 else -3.0

    def moved(self, u):
        return 0.8 * self.x + 0.25 * u + 0.1 * self.load() - 0.7

    def info(self):
        return {"disturbance": np.array([self.load()])}


def loaded(E, **given) -> LinearMPC:
    model = LinearModel([[0.8]], [[0.2]], 1, E=E, **given)
    bound = [5.0, 3.0][: model.n_disturbances]
    return LinearMPC(
        model, Q=[[1]], R=[[0.02]], horizon=5, x_min=-50, x_max=50, u_min=-30, u_max=30,
        tracking=Tracking([0], -4, 4), disturbances=DisturbanceBounds(-np.array(bound), bound),
    )  # fmt: skip


@pytest.mark.parametrize("how", ["offset_free", "by hand"])
@pytest.mark.parametrize("between", [False, True])
def test_with_a_measured_load_and_an_observer_the_plant_rests_at_its_set_point(how, between):
    if how == "offset_free":
        mpc, observer = offset_free(loaded([[0.07]]), [3.0])
    else:
        mpc = loaded([[0.07, 1.0]], estimated=[1])
        observer = DisturbanceObserver(mpc.model)
    env = MeasuredDisturbance(SetPoint(Loaded(), [1.5], [1.5001]), [-5], [5])
    env = gym.wrappers.TimeLimit(env, 500) if between else env
    env = ObserveDisturbance(env, observer, mpc.disturbances.d_min, mpc.disturbances.d_max)
    law = mpc.law()
    theta, _ = env.reset(seed=1)
    seen = []
    for _ in range(160):
        theta, *_ = env.step(law(theta))
        seen.append(theta[0])
    np.testing.assert_allclose([seen[58], seen[-1]], theta[1], atol=1e-4)
    # The load alone moves it little: the observer knows what it does, but for the model's error.
    assert np.abs(np.array(seen[60:]) - theta[1]).max() < 0.3


@pytest.mark.parametrize(
    "use",
    [
        StageCost,
        lambda env, mpc: DDPG("YannPolicy", env, policy_kwargs={"problem": mpc}),
        lambda env, mpc: in_deviations(lambda: env, mpc),  # of improve and headroom
    ],
)
def test_wrappers_in_another_order_than_theta_are_refused(use) -> None:
    mpc, observer = offset_free(loaded([[0.07]]), [3.0])
    box = mpc.disturbances.d_min, mpc.disturbances.d_max
    late = MeasuredDisturbance(Loaded(), [-5], [5])
    with pytest.raises(ValueError, match=r"SetPoint appends .* From the inside outward it is Past"):
        use(SetPoint(ObserveDisturbance(late, observer, *box), [-4], [4]), mpc)
    right = MeasuredDisturbance(SetPoint(Loaded(), [-4], [4]), [-5], [5])
    use(ObserveDisturbance(right, observer, *box), mpc)
    model = LinearModel([[0.8]], [[0.2]], 1, C=[[1.0]])
    plain = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, tracking=Tracking([0], -4, 4), u_min=-30,
                      u_max=30, x_min=-50, x_max=50)  # fmt: skip
    use(SetPoint(EstimateState(Loaded(), StateEstimator(model)), [-4], [4]), plain)


def test_bounds_of_measured_disturbances_are_left_out_where_none_is_estimated() -> None:
    model = LinearModel(np.eye(2) / 2, np.ones((2, 1)), 1.0, E=np.ones((2, 1)))
    env = MeasuredDisturbance(Counter(), -1, 1)
    assert EstimateState(env, StateEstimator(model), -1, 1).observation_space.shape == (3,)


def test_an_observer_without_a_measured_load_is_refused_in_any_order() -> None:
    mpc = loaded([[0.07, 1.0]], estimated=[1])
    knows = DisturbanceObserver(mpc.model)
    blind = DisturbanceObserver(LinearModel([[0.8]], [[0.2]], 1, E=[[1.0]]))
    plain = SetPoint(Loaded(), [-1], [1])
    measured = MeasuredDisturbance(plain, [-5], [5])
    for env in (measured, PreviousInput(measured), PastInputs(measured, [1])):
        with pytest.raises(ValueError, match=r"measures 1 disturbances .* takes 0"):
            ObserveDisturbance(env, blind, [-3], [3])
    with pytest.raises(ValueError, match=r"measures 0 disturbances .* takes 1"):
        ObserveDisturbance(plain, knows, [-3], [3])
    with pytest.raises(ValueError, match="in ObserveDisturbance already"):
        MeasuredDisturbance(ObserveDisturbance(plain, blind, [-3], [3]), [-5], [5])
    swapped = DisturbanceObserver(LinearModel([[0.8]], [[0.2]], 1, E=[[1, 0.07]], estimated=[0]))
    with pytest.raises(ValueError, match="before the estimated ones"):
        ObserveDisturbance(measured, swapped, [-3], [3])


# ---- Wrappers show plant units, and the cost is that of the problem ----


X_SS = np.array([350.0, 2.0])
U_SS = np.array([10.0])
MODEL = LinearModel([[0.9, 0.2], [0, 0.7]], [[0], [1]], 1.0, X_SS, U_SS)
MPC = LinearMPC(
    MODEL, Q=np.eye(2), R=[[1]], horizon=2, u_min=8, u_max=15, theta_min=[300, 0],
    theta_max=[400, 4],
)  # fmt: skip


class Reactor(Sampled):
    """The model, as a plant that shows temperatures and takes flows."""

    observation_space = gym.spaces.Box(np.array([300.0, 0.0]), np.array([400.0, 4.0]), dtype=float)
    action_space = gym.spaces.Box(np.float32([8]), np.float32([15]))
    starts = ([355.0, 2.5], [355.0, 2.5])

    def moved(self, u):
        assert self.action_space.contains(np.float32(u))
        return X_SS + MODEL.step(self.x - X_SS, u - U_SS)


def test_a_map_that_does_not_fit_is_named() -> None:
    env = Reactor()
    with pytest.raises(ValueError, match=r"What the map makes of it has shape \(1,\)"):
        StageCost(env, MPC, observation=AffineObservation([[1, 0]]))
    with pytest.raises(TypeError, match="observation = 3 must be an AffineObservation"):
        StageCost(env, MPC, observation=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("normalized", [False, True])
def test_the_stage_cost_is_that_of_what_the_plant_shows_and_takes(normalized: bool) -> None:
    plant: Any = Reactor()
    if normalized:
        plant = gym.wrappers.RescaleAction(plant, np.float32([-1]), np.float32([1]))
    env = StageCost(plant, MPC)
    x = env.reset(seed=0)[0]
    action = np.array([0.0 if normalized else 11.5], np.float32)
    reward = env.step(action)[1]
    assert reward == pytest.approx(-float(MPC.stage_cost(x, [11.5])))
    assert reward == pytest.approx(-float(MPC.deviations.stage_cost(x - X_SS, [1.5])))


class Valve(gym.Env):
    """A level of 5 m, and a flow of 2 to 8 m3/h."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float64)

    def __init__(self, low: float, high: float) -> None:
        self.action_space = gym.spaces.Box(low, high, (1,), np.float64)


def test_an_observer_shows_plant_units() -> None:
    """The same numbers as about zero, with the operating point put on."""
    E = [[0.0], [1.0]]
    d_ss = [0.25]
    model = LinearModel(MODEL.A, MODEL.B, 1.0, X_SS, U_SS, E, d_ss)
    own = LinearModel(MODEL.A, MODEL.B, 1.0, E=E)
    env = ObserveDisturbance(Reactor(), DisturbanceObserver(model), -2, 2)
    observer = DisturbanceObserver(own)
    shown = [env.reset(seed=0)[0]]
    expected = [np.append(*observer.reset(env.unwrapped.x - X_SS))]
    for u in (11.0, 9.0, 14.0):
        shown.append(env.step(np.float32([u]))[0])
        expected.append(np.append(*observer.update(env.unwrapped.x - X_SS, u - U_SS)))
    rest = np.array([*X_SS, *d_ss])
    np.testing.assert_allclose(shown, np.array(expected) + rest, rtol=1e-12)  # in float64


@pytest.mark.parametrize("wrap", [PreviousInput, lambda env, **u: PastInputs(env, [2], **u)])
def test_what_cannot_have_been_played_before_an_episode_is_asked_for(wrap: Any) -> None:
    with pytest.raises(ValueError, match=r"takes inputs from \[2.0\] to \[8.0\].*Pass initial"):
        wrap(Valve(2.0, 8.0))
    assert wrap(Valve(2.0, 8.0), initial=[5.0]).initial.tolist() == [5.0]
    with pytest.raises(ValueError, match=r"from \[0.0\] to \[8.0\]: zero, .*is hardly the one"):
        wrap(Valve(0.0, 8.0))  # a valve that is open from 0 to 100 % was open before
    wrap(Valve(-2.0, 8.0))
    PastInputs(Valve(2.0, 8.0), [0])


def test_an_observation_that_is_a_column_is_named() -> None:
    class Column(Reactor):
        def reset(self, **kwargs: Any) -> Any:
            observation, info = super().reset(**kwargs)
            return np.reshape(observation, (-1, 1)), info

    env = StageCost(Column(), MPC)
    with pytest.raises(ValueError, match=r"observation of shape \(2, 1\), .* has \(2,\)"):
        env.reset(seed=0)


class Fed(gym.Wrapper):
    """Tells its feed, near 10 kg/min."""

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)[0], {"disturbance": [10.5]}


def test_a_measured_disturbance_is_what_the_plant_tells() -> None:
    plain = MeasuredDisturbance(Fed(Reactor()), 8, 12)
    assert plain.reset(seed=0)[0][-1] == 10.5
    model = LinearModel(
        np.eye(2) / 2, np.ones((2, 1)), 1.0, X_SS, [10], np.hstack([np.ones((2, 1)), np.eye(2)]),
        [10.0, 0, 0], estimated=[1, 2],
    )  # fmt: skip
    env = ObserveDisturbance(plain, DisturbanceObserver(model), [-2, -2], [2, 2])
    env.reset(seed=0)
    assert env.load.tolist() == [0.5]  # the observer counts from its operating point
