"""The Gaussian process and the network: what they learn, how they shrink, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import PlantTwin
from sb3_yann.twin.gaussian_process import POINTS, GaussianProcess
from sb3_yann.twin.network import Network
from twin_samples import log, problem

KINDS = ("gaussian process", "network")


def make(kind: str, offset: bool = False, stiffness: float = 1.0, seed: int = 0):
    if kind == "network":
        return Network(np.random.default_rng(seed), 1e-5 * stiffness, offset)
    return GaussianProcess(offset, stiffness)


def data(noise: float = 0.01, constant: float = 0.0):
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, (300, 3))
    y = np.column_stack([z[:, 0] * z[:, 1], np.sin(3 * z[:, 2])]) + constant
    return z, y + noise * rng.standard_normal(y.shape), y


@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_a_curved_function_from_noisy_rows(kind) -> None:
    z, noisy, y = data()
    found = make(kind).fit(z, noisy).predict(z)
    assert np.sqrt(np.mean((found - y) ** 2)) < 0.01


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("offset", [False, True])
def test_derivatives_are_those_of_differences(kind, offset) -> None:
    z, noisy, _ = data()
    fitted, step = make(kind, offset).fit(z, noisy), 1e-3
    moved = step * np.eye(3)
    slopes = [(fitted.predict(z + e) - fitted.predict(z - e)) / (2 * step) for e in moved]
    np.testing.assert_allclose(fitted.jacobian(z), np.stack(slopes, -1), atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_equilibrium_stays_unless_there_is_an_offset(kind) -> None:
    z, _, y = data(constant=0.5)
    zero = np.zeros((1, 3))
    np.testing.assert_allclose(make(kind).fit(z, y).predict(zero), 0, atol=1e-12)
    np.testing.assert_allclose(make(kind, offset=True).fit(z, y).predict(zero), 0.5, atol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_stiffness_leads_to_the_linear_model(kind) -> None:
    z, noisy, _ = data()
    sizes = [np.abs(make(kind, stiffness=s).fit(z, noisy).predict(z)).max() for s in (1, 1e14)]
    assert sizes[0] > 0.9 and sizes[1] < 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_a_stack_says_what_its_members_say(kind) -> None:
    z, noisy, _ = data()
    parts = slice(0, 40), slice(50, 300)  # the first part is too small for all points
    members = [make(kind, seed=i).fit(z[part], noisy[part]) for i, part in enumerate(parts)]
    stack, at = type(members[0]).stack(members), np.array([z[:20], z[20:40]])
    for method in ("predict", "jacobian"):
        expected = [getattr(each, method)(rows) for each, rows in zip(members, at, strict=True)]
        np.testing.assert_allclose(getattr(stack, method)(at), expected, rtol=1e-6, atol=1e-9)


def test_a_member_of_the_network_starts_elsewhere_and_a_residual_of_zero_stays() -> None:
    z, noisy, y = data()
    one, other = (make("network", seed=seed).fit(z, noisy) for seed in (0, 1))
    assert np.abs(one.predict(z) - other.predict(z)).max() > 1e-4
    for kind in KINDS:
        assert np.all(make(kind).fit(z, 0 * y).predict(z) == 0)


def test_of_the_likelihood_the_slope_is_that_of_differences() -> None:
    z, noisy, _ = data()
    at = np.array([0.3, 1.0, 0.5, -2.0, -4.0])
    for offset in (False, True):
        process = GaussianProcess(offset)
        found = process._unlikeliness(at, z[:60], noisy[:60])[1]
        moves = 1e-5 * np.eye(5)
        slopes = [
            (
                process._unlikeliness(at + e, z[:60], noisy[:60])[0]
                - process._unlikeliness(at - e, z[:60], noisy[:60])[0]
            )
            / 2e-5
            for e in moves
        ]
        np.testing.assert_allclose(found, slopes, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_twin_has_it_where_it_is_asked_for_and_again_by_its_seed(kind) -> None:
    one, again = (PlantTwin.fit(problem(), log(3), residuals=[kind], seed=4) for _ in range(2))
    assert one.kind.startswith(kind) and one.trust.cost_error < 0.25
    theta, u = np.random.default_rng(0).uniform(-1, 1, (5, 9, 2)), np.zeros((5, 9, 1))
    np.testing.assert_array_equal(one.dynamics.step(theta, u), again.dynamics.step(theta, u))
    far = np.abs(one.dynamics.residual(1e6 * theta, u)).max()
    assert far < 10 * np.abs(one.dynamics.residual(theta, u)).max()


def test_the_process_is_carried_by_few_points() -> None:
    z, noisy, _ = data()
    fitted = GaussianProcess().fit(z, noisy)
    assert fitted.points.shape == (POINTS, 3)
    assert {tuple(row) for row in fitted.points} <= {tuple(row) for row in z} | {(0.0, 0.0, 0.0)}
