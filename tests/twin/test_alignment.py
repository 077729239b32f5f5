"""Logs whose inputs are not those that acted: rows, columns, signs, units; and frozen sensors."""

import re
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC, PlantEnv, PlantTwin, RateLimits, Tracking, identify
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.alignment import Logged
from sb3_yann_envs import cstr, problems

GAINS = np.array([1.5, 0.7])
SELECT = ["none", "linear"]


@cache
def mpc() -> LinearMPC:
    model = LinearModel([[0.9, 0.15], [0.0, 0.7]], [[0.1, 0.0], [0.05, 0.3]], 1.0)
    return LinearMPC(
        model, Q=np.diag([2.0, 1.0]), R=0.2 * np.eye(2), horizon=3, u_min=-1, u_max=1,
        x_min=-4, x_max=4,
    )  # fmt: skip


def logged(kind: str, seed: int = 0, noise: float = 0.01) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return episodes of a plant of other gains: of the MPC, another controller, or open loop."""
    rng = np.random.default_rng(seed)
    law = mpc().explicit()
    found = []
    for _ in range(6):
        x = rng.uniform(-1.5, 1.5, 2)
        held = np.zeros(2)
        states = [x + noise * rng.normal(size=2)]
        inputs = []
        for k in range(40):
            held = rng.uniform(-0.4, 0.4, 2) if k % 5 == 0 else held
            u = held
            if kind == "the MPC":
                u = law(states[-1])
            elif kind == "another controller":
                gentle = np.array([[0.8, 0.1], [0.0, 0.7]]) @ states[-1]
                u = np.clip(0.08 * rng.normal(size=2) - gentle, -1, 1)
            x = mpc().model.A @ x + mpc().model.B @ (GAINS * u)
            states.append(x + noise * rng.normal(size=2))
            inputs.append(u)
        found.append((np.array(states), np.array(inputs)))
    return found


def stuck(x: np.ndarray, state: int) -> np.ndarray:
    """Return states of which one reads the same for a quarter of the rows."""
    x = x.copy()
    x[8:18, state] = x[8, state]
    return x


FAULTS = {
    "a row early": lambda x, u: (x[:-1], u[1:]),
    "a row late": lambda x, u: (x[1:], u[:-1]),
    "inputs exchanged": lambda x, u: (x, u[:, ::-1]),
    "states exchanged": lambda x, u: (x[:, ::-1], u),
    "a sign": lambda x, u: (x, u * [1, -1]),
    "both signs": lambda x, u: (x, -u),
    "a hundredth": lambda x, u: (x, 0.01 * u),
    "a tenth": lambda x, u: (x, 0.1 * u),
    "a fraction of the range": lambda x, u: (x, 0.5 + 0.5 * u),
    "a frozen sensor": lambda x, u: (stuck(x, 0), u),
    "the other one frozen": lambda x, u: (stuck(x, 1), u),
}
KINDS = ("the MPC", "another controller", "open loop")


def fitted(episodes: list) -> PlantTwin:
    return PlantTwin.fit(mpc(), episodes, residuals=SELECT, n_members=1)


SAID = {
    "a row early": "u[0] is what the MPC gives u[0] in the row after",
    "a row late": "u[0] is what the MPC gives u[0] in the row before",
    "inputs exchanged": "u[0] is what the MPC gives u[1] in the same row",
    "a sign": "u[1] is minus what the MPC gives u[1] in the same row",
    "a tenth": "u[0] is 0.1 times what the MPC gives",
    "a fraction of the range": "u[1] is 0.5 times what the MPC gives, +0.5",
    "states exchanged": "where x[0] and x[1] are exchanged",
    "a frozen sensor": "x[0] reads exactly",
}
"""What the report says of a log of the MPC."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_log_whose_columns_are_not_what_acted_is_not_trusted(kind, fault) -> None:
    twin = fitted([FAULTS[fault](x, u) for x, u in logged(kind)])
    assert not twin.trusted
    assert kind != "the MPC" or SAID.get(fault, "") in twin.report()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_a_sound_log_has_nothing_against_its_columns(kind, noise) -> None:
    for seed in range(2):
        twin = fitted(logged(kind, seed, noise))
        assert twin.trusted, twin.report()


@pytest.mark.parametrize("biased", [0, 1])
def test_a_biased_column_is_named_and_no_other_is(biased) -> None:
    log = [(x + 0.4 * np.eye(2)[biased], u) for x, u in logged("the MPC", noise=0.003)]
    said = " ".join(fitted(log).trust.problems)
    assert f"inputs where x[{biased}] is what is logged, -0.4" in said
    assert f"x[{1 - biased}]" not in said and "The logged u" not in said


@pytest.mark.parametrize("samples", [2, 3])
def test_a_log_whose_rows_are_samples_apart_says_so(samples) -> None:
    log = [
        (x[::samples], u[::samples][: len(x[::samples]) - 1])
        for x, u in logged("the MPC", noise=0.003)
    ]
    assert f"as the model's do in {samples} samples" in fitted(log).report()
    assert fitted(logged("the MPC", noise=0.003)).trusted


def test_consecutive_pieces_of_a_record_are_tested_as_episodes() -> None:
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-0.8, 0.8, (60, 2)), 10, axis=0)
    x = [np.zeros(2)]
    for each in u:
        x.append(mpc().model.A @ x[-1] + mpc().model.B @ (GAINS * each) + 0.02 * x[-1] ** 2)
    states = np.array(x)
    twin = fitted([(states[i : i + 61], u[i : i + 60]) for i in range(0, 600, 60)])
    assert twin.trusted
    assert "Every other one is independent: 5 of 10." in twin.report()


@cache
def room() -> LinearMPC:
    """Air and walls of a room, and one heater: nothing was tuned on it."""
    model = LinearModel([[0.8, 0.15], [0.06, 0.93]], [[0.3], [0.01]], 1.0)
    return LinearMPC(
        model, Q=np.diag([1.0, 0.2]), R=[[0.3]], horizon=4, u_min=-2, u_max=2, x_min=-6, x_max=6
    )


def heated(
    gain: float,
    dither: float,
    open_loop: bool = False,
    steps: int = 40,
    hold: int = 4,
    share: float = 1.0,
) -> list:
    """Return episodes of a room whose heater has so many times the model's gain.

    Its controller takes a share of the law.
    """
    rng = np.random.default_rng(5)
    law = room().explicit()
    found = []
    held = np.zeros(1)
    for _ in range(6):
        states = [rng.uniform(-2, 2, 2)]
        inputs = []
        for k in range(steps):
            drawn = rng.normal(size=1)
            held = drawn if k % hold == 0 else held
            wanted = 0.5 * held if open_loop else share * law(states[-1]) + dither * drawn
            inputs.append(np.clip(wanted, -2, 2))
            states.append(room().model.A @ states[-1] + gain * room().model.B @ inputs[-1])
        found.append((np.array(states), np.array(inputs)))
    return found


def heated_twin(episodes: list, **options: bool) -> PlantTwin:
    return PlantTwin.fit(room(), episodes, residuals=SELECT, n_members=1, **options)


@pytest.mark.parametrize("dither", [0.0, 0.2])
@pytest.mark.parametrize("gain", [0.4, 1.0, 2.2])
def test_inputs_that_the_mpc_gave_are_proven_whatever_the_gain_of_the_plant(gain, dither) -> None:
    assert heated_twin(heated(gain, dither)).trusted


@pytest.mark.parametrize(("factor", "dither"), [(0.3, 0.2), (0.55, 0.0), (0.55, 0.2), (0.8, 0.0)])
def test_inputs_times_a_factor_are_not_those_of_the_mpc(factor, dither) -> None:
    twin = heated_twin([(x, factor * u) for x, u in heated(1.0, dither)])
    assert "times what the MPC gives" in twin.report()
    assert not twin.trusted


@pytest.mark.parametrize(("share", "dither"), [(0.55, 0.2), (0.8, 0.2), (1.5, 0.4)])
def test_a_multiple_of_the_law_that_moves_the_plant_as_the_model_says_is_in_its_units(
    share, dither
) -> None:
    assert heated_twin(heated(1.0, dither, share=share)).trusted


def test_a_state_with_another_zero_and_scale_is_not_the_one_that_the_mpc_saw() -> None:
    twin = heated_twin([(x * [1.8, 1] + [0.5, 0], u) for x, u in heated(1.0, 0.2)])
    assert "The MPC gives the logged inputs where x[0] is" in twin.report()
    assert not twin.trusted


def test_episodes_of_the_mpc_prove_the_units_of_those_that_it_did_not_make() -> None:
    """The heater has less than half of the model's gain, which steps alone make doubtful."""
    steps = heated(0.4, 0.0, open_loop=True)
    both = heated(0.4, 0.0)[:3] + steps[3:]
    assert not heated_twin(steps).trusted
    assert heated_twin(both).trusted
    rests = heated(1.0, 0.0, steps=200)  # at rest other units give the same
    for given in (both, rests):
        for of_x, of_u, made in (
            ([1.0, 1.0], 1.0, True),
            ([1.8, 1.0], 1.0, False),
            ([1.0, 0.4], 1.0, False),
            ([1.0, 1.0], 0.55, False),
        ):
            found = heated_twin([(x * of_x, of_u * u) for x, u in given])
            logged = Logged(found.dynamics.coordinates, found.episodes)
            assert logged.made_by_law.all() == made


def test_a_gain_that_only_an_open_loop_shows_counts_once_the_units_are_confirmed() -> None:
    log = heated(2.2, 0.0, open_loop=True)
    assert "units_confirmed=True" in heated_twin(log).report()
    assert not heated_twin(log).trusted
    assert heated_twin(log, units_confirmed=True).trusted
    assert heated_twin(heated(1.4, 0.0, open_loop=True)).trusted


def tank() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return level and temperature of a tank whose power acts over the level, both controlled."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(6):
        level = rng.uniform(0.1, 1.0)
        warm = rng.uniform(30, 70)
        level_set, warm_set, more = rng.uniform([0.1, 30, -10], [1.0, 80, 10])
        states = [(level, warm)]
        inputs = []
        for _ in range(150):
            q = np.clip(0.5 * np.sqrt(level) + 0.8 * (level_set - level), 0, 1.2)
            power = np.clip(q * (warm_set - 20) + level * (warm_set - warm) + more, 0, 80)
            for _ in range(5):
                level = max(0.1, level + 0.1 * (q - 0.5 * np.sqrt(level)))
                warm += 0.1 * (q * (20 - warm) + power) / level
            states.append((level, warm))
            inputs.append((q, power))
        found.append((np.array(states), np.array(inputs)))
    return found


def test_a_gain_that_depends_on_the_level_is_no_unit() -> None:
    log = tank()
    problem = LinearMPC(
        identify(*zip(*log, strict=True), dt=10.0).model, Q=np.diag([10, 0.1]),
        R=np.diag([1, 1e-3]), horizon=5, u_min=0, u_max=[1.2, 200], x_min=[0.05, 0], x_max=[4, 300],
    )  # fmt: skip
    of = partial(PlantTwin.fit, problem, residuals=["none", "quadratic"])
    assert of(log).trusted
    other = of([(x, u * [1, 2]) for x, u in log])
    assert "The logged u[1] moves the plant" in other.report() and not other.trusted


@cache
def reactor():
    return evaluate(problems.cstr().explicit(), "CSTR-v0", seeds=range(3)).pairs


KELVIN = np.array([0.0, 0.0, *cstr.X_SS[2:]])
PER_CENT = np.array([100.0, 100.0, 1.0, 1.0])


def refuse_or_doubt(mpc, episodes) -> None:
    try:
        found = PlantTwin.fit(mpc, episodes)
    except ValueError as refused:
        assert "A log is in plant units where" in str(refused)
    else:
        assert not found.trusted and "Compare units" in " ".join(found.trust.advice)


@pytest.mark.parametrize(
    "change",
    [
        lambda x, u: (x + cstr.X_SS, u),
        lambda x, u: (x + KELVIN, u),
        lambda x, u: (PER_CENT * x, u),
        lambda x, u: (x, u + cstr.U_SS),
    ],
    ids=["absolute", "kelvin", "per cent", "absolute input"],
)
def test_a_reactor_s_log_in_other_units_is_refused_or_not_trusted(change) -> None:
    refuse_or_doubt(problems.cstr(), [change(x, u) for x, u in reactor()])


def test_what_is_missing_in_a_poor_log_is_advised() -> None:
    one = reactor()[:1]
    still = [(x, 0 * u + 0.1) for x, u in reactor()]
    for episodes, advice in (
        (one, "Log at least one episode more"),
        (still, "Make a small step test on U,"),
    ):
        found = PlantTwin.fit(problems.cstr(), episodes, residuals=["none", "linear"])
        assert not found.trusted and advice in found.report()


def test_the_input_of_an_mpc_in_a_closed_loop_is_not_its_own() -> None:
    law = problems.cstr().explicit()
    found = PlantTwin.fit(problems.cstr(), [(x, law(x[:-1])) for x, _ in reactor()])
    assert found.trust.excitation < 1e-9  # though it is no linear function of the state
    assert "0.00 %: its gain rests on the given B" in found.report()
    rng = np.random.default_rng(0)
    dithered = [(x, np.clip(u + rng.normal(0, 10, u.shape), -55, 55)) for x, u in reactor()]
    assert PlantTwin.fit(problems.cstr(), dithered).trust.excitation > 0.02


def test_an_input_that_is_held_excites_though_the_one_before_tells_it() -> None:
    plant = LinearModel([[0.9]], [[0.1]], 1.0)
    box = {"u_min": -1, "u_max": 1, "theta_min": -2, "theta_max": 2}
    mpc = LinearMPC(plant, Q=[[1]], R=[[1]], horizon=3, rate=RateLimits(-0.5, 0.5), **box)
    rng = np.random.default_rng(0)
    log = []
    for _ in range(3):
        test = np.repeat(rng.uniform(-0.3, 0.3, 10), 20)
        theta = [np.zeros(2)]
        for moved in test:
            u = -0.3 * theta[-1][0] + moved
            theta.append(np.array([0.9 * theta[-1][0] + 0.1 * u + rng.normal(0, 0.1), u]))
        log.append((np.array(theta), np.array(theta)[1:, 1:]))
    assert PlantTwin.fit(mpc, log, residuals=["none"]).trust.excitation > 0.5


def test_set_points_excite_a_closed_loop() -> None:
    mpc = LinearMPC(
        LinearModel([[0.9]], [[0.1]], 1.0), Q=[[1]], R=[[1]], horizon=3, u_min=-1, u_max=1,
        theta_min=-2, theta_max=2, tracking=Tracking([0], -0.5, 0.5),
    )  # fmt: skip
    worn = PlantEnv(lambda x, u: np.log(0.9) * (x - 0.8 * u), mpc, hold=25)
    log = evaluate(mpc.explicit(), worn, seeds=range(5))
    twin = PlantTwin.fit(mpc, [*zip(log.observations, log.actions, strict=True)], residuals=SELECT)
    assert "its gain is known from the log" in twin.report() and not twin.trust.advice
    assert "share of it neither states nor the MPC at held set-points tell:\n" in twin.report()
    assert twin.reidentified().model.B == pytest.approx(0.8 * mpc.model.B, rel=0.01)


def test_a_plant_that_is_not_linear_is_led_on_to_where_it_rests() -> None:
    # A tank whose outflow goes with the root of its level, fitted far from its operating point.
    records = []
    for seed in range(8):
        u = np.repeat(np.random.default_rng(seed).uniform(0.1, 1, 10), 20)[:, None]
        x = np.ones((201, 1))
        for k in range(200):
            x[k + 1] = x[k] + 0.25 * u[k] - 0.15 * np.sqrt(x[k])
        records.append((x, u))
    states, inputs = zip(*records, strict=True)
    bounds = {"u_min": 0.1, "u_max": 1, "x_min": 0, "x_max": 12, "horizon": 5}
    mpc = LinearMPC(identify(states, inputs, dt=0.5, u_ss=[0.9]), Q=[[1]], R=[[1]], **bounds)
    (said,) = PlantTwin.fit(mpc, records, residuals=["none", "quadratic"]).trust.problems
    told = re.search(r"mpc = replace\(mpc, model=replace\(mpc\.model, x_ss=\[(.*)\]\)\)", said)
    assert told and abs(float(told[1]) - 2.25) < 0.1  # where 0.5 u is 0.3 times the root
    mpc = replace(mpc, model=replace(mpc.model, x_ss=[float(told[1])]))
    assert PlantTwin.fit(mpc, records, residuals=["none", "quadratic"]).trusted
