"""An ensemble of networks learns what a linear model leaves of a plant's steps."""

from dataclasses import replace
from functools import cache

import numpy as np

from guard_samples import random_states
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import fit_ensemble
from twin_samples import log, observed, problem


def episodes(count: int, noise: float = 0.0, first: int = 0) -> list[Episode]:
    """Return the cart's episodes, with inputs that are random by half."""
    rng = np.random.default_rng(first)
    law = problem().explicit()

    def act(x: np.ndarray) -> np.ndarray:
        return np.clip(law(x) + rng.uniform(-0.5, 0.5, 1), -1, 1)

    return [Episode(*each) for each in log(count, noise, first, act)]


@cache
def coordinates(noise: float = 0.0) -> Coordinates:
    return Coordinates.of(RowLayout(problem()), episodes(8, noise))


@cache
def fitted(updates: int = 800) -> tuple[Residual, ...]:
    logs = [episodes(8), episodes(8)[:5]]
    return tuple(fit_ensemble(coordinates(), logs, seed=3, updates=updates))


def test_it_learns_a_nonlinear_map_that_it_predicts_where_it_has_not_seen_it() -> None:
    unseen = episodes(5, first=50)
    z, y = map(np.concatenate, zip(*map(coordinates().regression, unseen), strict=True))
    about = np.hstack([z, np.ones((len(z), 1))])
    linear = y - about @ np.linalg.lstsq(about, y, rcond=None)[0]
    for residual in fitted():
        error = residual.predict(z) - y
        assert np.mean(error[:, 1] ** 2) < 0.05 * np.mean(linear[:, 1] ** 2)
        assert np.abs(error[:, 0]).max() < 1e-3 * coordinates().units[0]  # the model has it


def test_a_seed_repeats_it_and_no_global_random_state_moves() -> None:
    drawn = random_states()
    first = fit_ensemble(coordinates(), [episodes(8)], seed=1, ahead=5, updates=50)
    assert random_states() == drawn
    again = fit_ensemble(coordinates(), [episodes(8)], seed=1, ahead=5, updates=50)
    other = fit_ensemble(coordinates(), [episodes(8)], seed=2, ahead=5, updates=50)
    for a, b in zip(first[0].weights, again[0].weights, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0].weights[0], other[0].weights[0])


def test_windows_do_not_take_noise_of_the_sensors_for_dynamics() -> None:
    noise = 0.05
    unseen = episodes(5, first=50)
    seen = episodes(8, noise)
    box = coordinates(noise)
    errors = []
    for ahead in (1, 20):
        members = fit_ensemble(box, [seen], seed=0, ahead=ahead, updates=600)
        dynamics = Dynamics(problem(), box, tuple(members))
        runs = [dynamics.replay(e, np.array([0, 20, 40]), 20)[0, :, -1] for e in unseen]
        actual = [e.thetas[[20, 40, 60]] for e in unseen]
        errors.append(np.sqrt(np.mean((np.array(runs) - actual) ** 2)))
    assert errors[1] < 0.7 * errors[0]


def test_episodes_that_are_shorter_than_a_window_are_left_out_of_windows_only() -> None:
    short = [Episode(e.thetas[:9], e.actions[:8]) for e in episodes(4)]
    logs = [short, short + episodes(1), episodes(4)]
    for each in fit_ensemble(coordinates(), logs, seed=0, ahead=20, updates=50):
        assert all(np.isfinite(part).all() for part in each.weights)


def test_with_an_observer_it_is_fitted_to_what_the_plant_did() -> None:
    twin = observed()
    box = twin.dynamics.coordinates
    (found,) = fit_ensemble(box, [twin.episodes], seed=0, ahead=5, updates=400)
    learnt = replace(twin.dynamics, members=(found,))
    one = twin.episodes[0]
    rows = learnt.step(one.thetas[None, :-1], one.actions[None])[0]
    error = (rows - one.thetas[1:])[:, box.row.state] / box.units
    assert np.sqrt(np.mean(error**2)) < 0.02
