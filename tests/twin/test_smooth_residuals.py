"""The Gaussian process: what it learns, how it shrinks, and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import PlantTwin
from sb3_yann.twin.gaussian_process import POINTS, GaussianProcess
from twin_samples import log, problem

KINDS = ("gaussian process",)


def make(kind: str, offset: bool = False, stiffness: float = 1.0, seed: int = 0):
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


def test_a_residual_of_zero_stays() -> None:
    z, _, y = data()
    assert np.all(make("gaussian process").fit(z, 0 * y).predict(z) == 0)


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


@pytest.mark.parametrize("kind", [*KINDS, "network"])
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


def kernel(process: GaussianProcess, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The squared-exponential kernel, less what knowing the function at zero takes off it."""

    def k(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * np.sum(((x[:, None] - y) / process.lengths) ** 2, axis=2))

    zero, known = np.zeros((1, a.shape[1])), 0.0 if process.offset else 1.0
    return k(a, b) - known * k(a, zero) * k(zero, b)


@pytest.mark.parametrize("offset", [False, True])
def test_the_likelihood_is_that_of_the_book(offset) -> None:
    """Rasmussen and Williams, equation 5.8, the variance y' K^-1 y / N; constants left out."""
    z, noisy, _ = data()
    z, y, logs = z[:40], noisy[:40], np.array([0.3, 1.0, 0.5, -2.0, -4.0])
    process = GaussianProcess(offset)
    found = process._unlikeliness(logs, z, y)[0]
    expected = 0.0
    for i, noise in enumerate(np.exp(logs[3:])):
        K = kernel(process, z, z) + noise * np.eye(40)
        variance = y[:, i] @ np.linalg.solve(K, y[:, i]) / 40
        expected += 0.5 * (np.linalg.slogdet(K)[1] + 40 * np.log(variance))
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("offset", [False, True])
def test_with_all_points_it_is_the_mean_of_the_process(offset) -> None:
    z, noisy, _ = data()
    z, y, at = z[:60], noisy[:60], np.random.default_rng(1).uniform(-1, 1, (9, 3))
    for stiffness in (1.0, 30.0):
        process = GaussianProcess(offset, stiffness)
        # Noise large enough that every point is worth picking, and of one size for each output.
        process._most_likely = lambda *_: (np.array([0.5, 0.6, 0.7]), np.array([0.01, 0.2]))
        process.fit(z, y)
        for i, noise in enumerate((0.01, 0.2)):
            K = kernel(process, z, z) + stiffness * noise * np.eye(60)
            expected = kernel(process, at, z) @ np.linalg.solve(K, y[:, i])
            np.testing.assert_allclose(process.predict(at)[:, i], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("offset", [False, True])
def test_the_points_are_those_of_a_pivoted_cholesky_factorization(offset) -> None:
    z = np.random.default_rng(0).uniform(-1, 1, (POINTS + 40, 2))
    process = GaussianProcess(offset)
    process.lengths = np.array([0.05, 0.05])  # so short that each point tells something
    picked, root = process._factor(z)
    assert len(picked) == POINTS and root.shape == (POINTS + 40, POINTS)
    K = kernel(process, z, z)
    np.testing.assert_allclose((root @ root.T)[picked], K[picked], atol=1e-8)
    left = np.diag(K).copy()
    for step, row in enumerate(picked[:30]):
        assert row == np.argmax(left)
        left = np.diag(K - root[:, : step + 1] @ root[:, : step + 1].T)
    process.lengths = np.array([30.0, 30.0])
    few, root = process._factor(z)
    assert len(few) < 15
    np.testing.assert_allclose(root @ root.T, kernel(process, z, z), atol=1e-7)


def test_the_lengths_and_noises_are_those_that_made_the_rows() -> None:
    rng = np.random.default_rng(0)
    z = rng.uniform(-9, 9, (100, 2))
    process = GaussianProcess(offset=True)
    process.lengths = np.array([3.0, 6.0])
    draw = np.linalg.cholesky(kernel(process, z, z) + 1e-9 * np.eye(100))
    y = draw @ rng.standard_normal((100, 1)) + 0.1 * rng.standard_normal((100, 1))
    lengths, noises = process._most_likely(z, y)
    np.testing.assert_allclose(lengths, [3.0, 6.0], rtol=0.3)
    assert 0.003 < noises[0] < 0.03
    twice = np.concatenate([z, z[:50]])  # a row that stands there twice counts once
    again, _ = process._most_likely(twice, np.concatenate([y, y[:50]]))
    np.testing.assert_allclose(again, lengths)
    short, _ = GaussianProcess(True, shortest=4.0)._most_likely(z, y)
    assert short[0] == pytest.approx(4.0) and short[1] > 4.0


def test_residuals_of_any_size_are_learnt_as_well() -> None:
    z, noisy, _ = data()
    z, noisy, sizes = z[:60], noisy[:60], np.array([1e-6, 1e5])
    for kind in KINDS:
        plain, scaled = make(kind).fit(z, noisy), make(kind).fit(z, sizes * noisy)
        np.testing.assert_allclose(scaled.predict(z) / sizes, plain.predict(z), atol=0.02)
