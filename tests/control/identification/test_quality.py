"""Curvature is named from its definition's edges on, and is not taken for noise."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from errors import told
from sample_plants import played
from sb3_yann import identify
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.identification.residuals import curvature_test, listed, quality_notes
from sb3_yann.log import Episode


def log(steps: int = 300, curved: float = 0.0, noise: float = 0.1, seed: int = 0) -> Episode:
    """Return steps of a plant with two states, one input and one disturbance."""
    rng = np.random.default_rng(seed)
    driven = rng.uniform(-1, 1, (steps, 2))

    def step(x: np.ndarray, driven: np.ndarray) -> np.ndarray:
        u, d = driven
        moved = [0.8 * x[0] + u, 0.5 * x[1] + 0.3 * x[0] + d + curved * u * d]
        return moved + noise * rng.standard_normal(2)

    return Episode(played(step, driven, [0, 0]), driven)


def fit(episode: Episode) -> Regression:
    return regress([episode])


def test_what_curvature_explains_is_no_noise() -> None:
    colour = np.array([0.0, 0.3])
    for curved, noisy in ((0.0, True), (0.25, False), (1.0, False)):
        episode = log(curved=curved)
        found = dataclasses.replace(fit(episode), autocorrelation=colour)
        text = "\n".join(quality_notes(found, [episode], [], (colour, colour), 0.0))
        assert ("are correlated" in text) == noisy
        share = curvature_test(fit(episode), [episode])[0]
        percent = f"explain {listed(100 * share)} % of the residuals' variance"
        assert (percent in text) == (curved > 0)
    assert share[1] > 0.5 > curvature_test(fit(log(curved=0.25)), [log(curved=0.25)])[0][1] > 0.1


def held(steps: int, inputs: int, hold: int, seed: int) -> np.ndarray:
    """Return random inputs in [-1, 1] that stay for some samples."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (steps // hold + 1, inputs)), hold, axis=0)[:steps]


def notes(x: np.ndarray, u: np.ndarray, **options: Any) -> str:
    """Return all that identify says of a log."""
    found: list[Any] = []
    warned = told(lambda: found.append(identify(x, u, dt=1, **options)))
    return " ".join([*found[0].model.notes, *warned])


def linear(order: int, measured: int, seed: int, hold: int, noise: float = 0.0) -> Any:
    """Return a log of some states of a stable linear plant."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(order, order))
    A *= 0.93 / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(order, 1))
    u = held(500, 1, hold, seed)
    x = played(lambda x, u: A @ x + B @ u, u, np.zeros(order))[:, :measured]
    return x + noise * x.std(axis=0) * rng.normal(size=x.shape), u


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("order", "measured"), [(2, 1), (4, 2), (5, 3)])
def test_a_linear_plant_with_states_that_are_not_measured_is_not_called_nonlinear(
    order: int, measured: int, seed: int
) -> None:
    for hold, noise in ((9, 0.0), (20, 0.0), (9, 0.002)):
        said = notes(*linear(order, measured, seed, hold, noise), delay="auto")
        assert "not linear" not in said
        if noise == 0:
            assert "not measured" in said and "Dead time: inputs" not in said


def test_a_second_order_plant_of_which_one_output_is_logged_has_no_dead_time_of_two() -> None:
    u = held(1500, 1, 12, 3)
    y = [0.0]
    v = 0.0
    for a in u[:, 0]:
        y.append(y[-1] + 0.07 * v)
        v = 0.95 * v + 0.2 * a
    x = np.array(y)[:, None]
    said = notes(x, u, delay="auto")
    assert "not measured" in said and "not linear" not in said and "Dead time: " not in said
    stacked = identify(np.hstack([x[1:], x[:-1]]), u[1:], dt=1, delay=1)
    assert stacked.ten_step_fit.min() > 99.9999


def tank(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.asarray(x + 0.15 * (1 + 0.7 * u - np.sqrt(x)))


def bilinear(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.asarray(0.85 * x + 0.25 * x * u + 0.4 * u)


@pytest.mark.parametrize("plant", [tank, bilinear])
@pytest.mark.parametrize("hold", [4, 12])
def test_a_plant_that_is_not_linear_is_still_called_so(plant: Any, hold: int) -> None:
    u = held(600, 1, hold, 1)
    assert "The plant is not linear" in notes(played(plant, u, [1]), u)
