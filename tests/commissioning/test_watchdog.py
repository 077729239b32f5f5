"""The watchdog is quiet on the plant that its twin describes, and barks at another."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sb3_yann import PlantTwin
from sb3_yann.commissioning.watchdog import Alarm, Watchdog
from twin_samples import DT, log, problem

NOISE = 0.0003
ONSET = 8
Transition = tuple[np.ndarray, np.ndarray, np.ndarray]


@cache
def watchdog(noise: float = 0.0) -> Watchdog:
    return Watchdog.of(PlantTwin.fit(problem(), log(6, noise)))


def drive(
    seed: int,
    noise: float = 0.0,
    *,
    force: float = 2.0,
    sensor: int | None = None,
    stuck: bool = False,
) -> list[Transition]:
    """Return an episode of the cart, with a fault from a step on."""
    rng = np.random.default_rng(seed)
    law = problem().explicit()
    x = rng.uniform([-1.5, -0.5], [1.5, 0.5])
    seen = None
    found = []
    u = held = np.zeros(1)
    for k in range(61):
        y = x + noise * rng.standard_normal(2)
        if sensor is not None and k > ONSET:
            y[sensor] = seen[sensor]
        if k:
            found.append((seen, u, y))
        u = law(y)
        if k <= ONSET:
            held = u
        seen = y
        applied = held if stuck else u
        pull = 0.3 * x[0] ** 2 - 0.8 * x[0]
        gain = force if k >= ONSET else 2.0
        x = np.array([x[0] + DT * x[1], 0.9 * x[1] + DT * (gain * applied[0] - pull)])
    return found


def barks(dog: Watchdog, episode: list[Transition]) -> tuple[int, Alarm] | None:
    dog.start(episode[0][0])
    alarms = ((k, dog.watch(*each)) for k, each in enumerate(episode))
    return next(((k, each) for k, each in alarms if each is not None), None)


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_the_plant_of_the_log_raises_no_alarm(noise) -> None:
    dog = watchdog(noise)
    assert [barks(dog, drive(seed, noise)) for seed in range(100, 120)] == [None] * 20
    assert dog.alarm is None


@pytest.mark.parametrize(("noise", "force"), [(0.0, 1.8), (0.0, 2.2), (NOISE, 1.4), (NOISE, 2.6)])
def test_a_drive_that_changes_is_found(noise, force) -> None:
    found = [barks(watchdog(noise), drive(seed, noise, force=force)) for seed in range(200, 210)]
    late = [each[0] - ONSET for each in found if each is not None]
    assert len(late) >= 8
    assert min(late) >= 0 and np.median(late) <= 15


@pytest.mark.parametrize("noise", [0.0, NOISE])
@pytest.mark.parametrize("sensor", [0, 1])
def test_a_frozen_sensor_is_found(noise, sensor) -> None:
    found = [barks(watchdog(noise), drive(s, noise, sensor=sensor)) for s in range(300, 310)]
    assert all(each is not None and ONSET <= each[0] <= ONSET + 12 for each in found)


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_a_stuck_actuator_is_found(noise) -> None:
    found = [barks(watchdog(noise), drive(seed, noise, stuck=True)) for seed in range(400, 410)]
    kinds = {each[1].kind for each in found if each is not None}
    assert sum(each is not None for each in found) >= 8
    assert kinds <= {"drift", "outside the band"}


def test_a_noisy_sensor_that_repeats_itself_is_frozen_also_at_rest() -> None:
    rng = np.random.default_rng(0)
    u = np.zeros(1)
    x = 1e-3 * rng.standard_normal((12, 2))
    quiet = [(x[k], u, x[k + 1]) for k in range(11)]
    assert barks(watchdog(0.002), quiet) is None
    x[6:, 0] = x[5, 0]
    step, alarm = barks(watchdog(0.002), [(x[k], u, x[k + 1]) for k in range(11)])
    assert (step, alarm.kind) == (7, "frozen sensor")
    assert "reading 0" in alarm.message


def test_a_settled_plant_repeats_itself_and_is_quiet() -> None:
    rest = np.zeros(2), np.zeros(1), np.zeros(2)
    assert barks(watchdog(), [rest] * 100) is None


@pytest.mark.parametrize("position", [0, 1, 2])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_a_number_is_an_alarm_and_no_error(position, value) -> None:
    transition = [each.copy() for each in drive(1)[0]]
    transition[position][0] = value
    dog = watchdog()
    dog.start(drive(1)[0][0])
    assert dog.watch(*transition).kind == "not a number"


def test_a_leap_is_outside_the_band_at_once() -> None:
    theta, u, after = drive(2)[0]
    found = barks(watchdog(), [(theta, u, after + np.array([0.2, 0.0]))])
    assert found == (0, watchdog().alarm) and found[1].kind == "outside the band"
    assert "x[0]" in found[1].message


def test_the_first_alarm_of_an_episode_stays_until_the_next_begins() -> None:
    dog = watchdog()
    theta, u, after = drive(1)[0]
    alarm = barks(dog, [(theta, u, after * np.nan)])[1]
    assert dog.watch(*drive(1)[1]) is alarm and dog.alarm is alarm
    dog.start(drive(1)[0][0])
    assert dog.alarm is None and dog.watch(*drive(1)[0]) is None


def test_what_cannot_be_calibrated_is_refused() -> None:
    with pytest.raises(TypeError, match="must be a PlantTwin"):
        Watchdog.of(problem())
    with pytest.raises(ValueError, match="one episode"):
        Watchdog.of(PlantTwin.fit(problem(), log(1)))
    with pytest.raises(ValueError, match="theta has shape"):
        watchdog().start(np.zeros(3))


def test_an_alarm_calls_sensors_by_their_names_and_shows_what_they_read() -> None:
    plain = problem()
    x_ss = np.array([100.0, 0.0])
    model = replace(plain.model.named(["place", "speed"], ["force"]), x_ss=x_ss)
    box = {"theta_min": plain.theta_min + x_ss, "theta_max": plain.theta_max + x_ss}
    mpc = replace(plain, model=model, **box)
    twin = PlantTwin.fit(mpc, [(x + x_ss, u) for x, u in log(6, 0.002)])
    rng = np.random.default_rng(0)
    u = np.zeros(1)
    x = 1e-3 * rng.standard_normal((12, 2))
    x[6:, 0] = x[5, 0]
    alarm = barks(Watchdog.of(twin), [(x[k], u, x[k + 1]) for k in range(11)])[1]
    assert f"place has been {100 + x[5, 0]:.6g} for" in alarm.message
    theta, u, after = drive(2)[0]
    alarm = barks(Watchdog.of(twin), [(theta, u, after + np.array([0.2, 0.0]))])[1]
    assert "place is off the twin's prediction" in alarm.message
