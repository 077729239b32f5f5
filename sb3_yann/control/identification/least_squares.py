"""The least-squares fit of one step: its ridge, its poles, its steady state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.gains import NORMAL, SURE_ERRORS, WIDE, Gains, count_integrators, responses
from sb3_yann.control.linear_system import combination, names
from sb3_yann.log import Episode, split_episodes
from sb3_yann.units import FLOAT32_ROUNDING

NOT_EXCITED = (
    "What does not move cannot be identified. Add a test signal to each input, independent of the "
    "state (a feedback law alone ties the inputs to it), leave out states that are constant or "
    "sums of others, or pass ridge > 0."
)


@dataclass(frozen=True, eq=False)
class Regression:
    """``x[k+1] = reached + coefficients (z[k] - center)``, n states x, p regressors z."""

    sizes: tuple[int, int, int]  # numbers of states, inputs and disturbances
    coefficients: Array  # (n, p)
    standard_errors: Array  # (n, p)
    center: Array  # (p,)
    reached: Array  # (n,)
    spread: Array  # (p,), root mean square about the center
    correlation: Array  # (p, p): its outer product with covariance is that of the coefficients
    covariance: Array  # (n, n), of the residuals
    autocorrelation: Array  # (n,), of residuals one step apart; zero where they are rounding
    degrees_of_freedom: int
    steps: int
    excitation: float  # smallest over largest singular value of the scaled regressors
    weakest: str  # what moved least

    def predict(self, regressors: Array) -> Array:
        """Return the next states (k, n) for regressors (k, n+m+d)."""
        return np.asarray(self.reached + (regressors - self.center) @ self.coefficients.T)


def regress(
    episodes: Sequence[Episode], origin: Array | None = None, ridge: float = 0.0
) -> Regression:
    """Return the least-squares fit of one step.

    It passes through ``origin`` (n+m+d,), by default the mean of the data: an offset is fitted.
    ``ridge`` weighs squared coefficients, each in units of its regressor's spread.
    """
    regressors, targets = stacked(episodes)
    steps = len(regressors)
    sizes = episodes[0].sizes
    unknowns = regressors.shape[1] + (origin is None)
    if steps <= unknowns:
        raise ValueError(
            f"There are {steps} steps to fit {unknowns} parameters for each state: too few. Record "
            "more, or hold less out (held_out)."
        )
    center = np.mean(regressors, axis=0) if origin is None else origin
    reached = np.mean(targets, axis=0) if origin is None else origin[: sizes[0]]
    centered = regressors - center
    spread = np.sqrt(np.mean(centered**2, axis=0))
    # What is left of a constant after its mean is taken off is rounding, not a signal.
    still = spread <= 1e-10 * np.max(np.abs(regressors), axis=0)
    scale = np.where(still, 1.0, spread)
    left, singular, right = np.linalg.svd(np.where(still, 0.0, centered / scale), False)
    labels = names(sizes)
    # 1e-6: least excitation, below which float32 rounding alone may be what moves
    missing = [v for s, v in zip(singular, right, strict=True) if s <= 1e-6 * singular[0]]
    if missing and ridge == 0:
        fixed = [f"{_direction(v, scale, labels)} never changes" for v in missing]
        raise ValueError(f"The data do not excite the plant: {'; '.join(fixed)}. {NOT_EXCITED}")
    inverse = right.T * (singular / (singular**2 + ridge)) if ridge else right.T / singular
    inverse = inverse / scale[:, None]
    coefficients = (inverse @ left.T @ (targets - reached)).T
    residuals = targets - reached - centered @ coefficients.T
    covariance = residuals.T @ residuals / (steps - unknowns)
    real = np.sum(residuals**2, axis=0) > 1e-20 * np.sum(targets**2, axis=0)
    return Regression(
        sizes=sizes,
        coefficients=coefficients,
        standard_errors=np.sqrt(np.diag(covariance))[:, None] * np.linalg.norm(inverse, axis=1),
        center=center,
        reached=reached,
        spread=spread,
        correlation=inverse @ inverse.T,
        covariance=covariance,
        autocorrelation=np.where(real, neighbors(residuals, episodes), 0.0),
        degrees_of_freedom=steps - unknowns,
        steps=steps,
        excitation=float(singular[-1] / singular[0]) if singular[0] > 0 else 0.0,
        weakest=_direction(right[-1], scale, labels),
    )


def stacked(episodes: Sequence[Episode]) -> tuple[Array, Array]:
    """Return the regressors (steps, p) and the next states (steps, n) of all episodes."""
    regressors = np.concatenate([each.regressors for each in episodes])
    return regressors, np.concatenate([each.states[1:] for each in episodes])


def _direction(weights: Array, scale: Array, labels: list[str]) -> str:
    """Return a combination of the scaled regressors in words, without terms of small weight."""
    largest = np.argmax(np.abs(weights))
    factors = weights / scale
    # 0.05: relative weight below which a regressor is left out of a combination
    small = np.abs(weights) <= 0.05 * np.abs(weights[largest])
    return combination(np.where(small, 0.0, factors / factors[largest]), labels, 4)


def neighbors(residuals: Array, episodes: Sequence[Episode]) -> Array:
    """Return the correlation (n,) of residuals (steps, n) with those one step before."""
    borders = np.cumsum([len(episode) for episode in episodes])[:-1]
    pairs = sum(np.sum(part[1:] * part[:-1], axis=0) for part in np.split(residuals, borders))
    power = np.sum(residuals**2, axis=0)
    return np.asarray(pairs / np.where(power > 0, power, 1.0))


WEAK = 0.01  # excitation below which a log is weak
RIDGES = 10.0 ** np.arange(-9, 0)  # ridges that are tried, relative to the number of steps


def regularized(
    found: Regression, fitted: list[Episode], tested: list[Episode], origin: Array | None
) -> tuple[Regression, float, list[str]]:
    """Return the fit, its ridge and notes; a log that is not weak has none.

    What a weak log says along the direction that moved least is noise or curvature, and one-step
    predictions do not show it. Free runs over what was held out, ``tested``, do. ValueError if a
    weak log leaves them as blind as the mean, with any ridge.
    """
    if found.excitation >= WEAK:
        return found, 0.0, []
    inner, outer = (fitted, tested) if tested else split_episodes(fitted, 0.2)
    ridges = np.array([0.0, *RIDGES]) * found.steps
    errors = np.array([_free_run(regress(inner, origin, r), outer) for r in ridges])
    # 1.0: error of free runs, in spreads of the states, from which the mean says as much
    if np.min(errors) >= 1.0:
        raise ValueError(
            f"The log is too weakly excited: {found.weakest} moved {found.excitation:.1e} times as "
            "much as the most excited combination, and with any ridge free runs over the data held "
            f"out miss by {np.min(errors):.2g} spreads of the states. Add a test signal to each "
            "input and record longer, or pass ridge=0 (or another number) to take such a fit."
        )
    # What rounding leaves of a perfect log counts as nothing.
    best = int(np.argmax(errors <= np.min(errors) + 1e-9))
    if best == 0:
        return found, 0.0, []
    note = (
        f"A ridge of {ridges[best]:.2g} was chosen by free runs over data held out: they miss by "
        f"{errors[best]:.2g} spreads of the states, without it by {errors[0]:.2g}. It biases "
        "weakly excited entries towards zero, which their standard errors leave out."
    )
    return regress(fitted, origin, float(ridges[best])), float(ridges[best]), [note]


def _free_run(found: Regression, episodes: list[Episode]) -> float:
    """Return the error of free runs, root mean square in spreads of the states."""
    free_run = 50  # steps of a free run
    n = found.reached.size
    squares = []
    unit = np.where(found.spread[:n] > 0, found.spread[:n], 1.0)
    for episode in episodes:
        for start in range(0, len(episode), free_run):
            x = episode.states[start]
            for k in range(start, min(start + free_run, len(episode))):
                x = found.predict(np.concatenate([x, episode.driven[k]])[None])[0]
                # One that runs away is as bad as can be, and its size says nothing.
                error = np.minimum(np.abs(x - episode.states[k + 1]) / unit, 1e3)
                x = np.clip(x, -1e150, 1e150)
                squares.append(np.mean(error**2))
    return float(np.sqrt(np.mean(squares)))


def pole_errors(found: Regression, n: int) -> tuple[Array, Array]:
    """Return the poles (n,), largest first, and their standard errors, inf of repeated poles.

    To first order a pole moves by ``y' dA x / y'x`` with its left and right eigenvectors. States
    after the first n are inputs on their way: they move none of these poles.
    """
    values, left, right = linalg.eig(found.coefficients[:n, :n], left=True, right=True)
    rows = np.real(np.sum(left.conj() * (found.covariance[:n, :n] @ left), axis=0))
    columns = np.real(np.sum(right.conj() * (found.correlation[:n, :n] @ right), axis=0))
    overlap = np.abs(np.sum(left.conj() * right, axis=0))
    size = np.sqrt(np.maximum(rows * columns, 0.0))
    errors = np.where(overlap > 1e-9, size / np.maximum(overlap, 1e-9), np.inf)
    order = np.argsort(-np.abs(values), kind="stable")
    return values[order], errors[order]


def gains_of(found: Regression) -> Gains:
    """Return what held inputs do to states in the end, with errors by the delta method."""
    step = 1e-3  # standard deviations, in which responses are linear
    n, m, _ = found.sizes
    A, B = np.split(found.coefficients[:, : n + m], [n], axis=1)
    part = found.correlation[: n + m, : n + m]

    def deviation(R: Array) -> float:
        return float(np.sqrt(max(np.trace(R @ found.covariance @ R.T @ part[:n, :n]), 0.0)))

    count = count_integrators(A, deviation)
    errors = np.zeros((4, n, m))
    for of_rows in _root(found.covariance):
        for of_columns in _root(part):
            by = step * np.outer(of_rows, of_columns)  # independent of the others
            more, less = (responses(A + d[:, :n], B + d[:, n:], count) for d in (by, -by))
            errors += ((more - less) / (2 * step)) ** 2
    return Gains.of(A, B, count, np.sqrt(errors))


def _root(covariance: Array) -> Array:
    """Return columns, as rows, whose outer products sum up to a covariance."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.maximum(np.outer(scale, scale), 1e-300))
    kept = values > 1e-15 * values[-1]
    return np.asarray((scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])).T)


def pole_note(values: Array, errors: Array, noise: str) -> str:
    """Return the 95 % intervals of poles in words, one of each complex pair."""
    words = []
    open_ends = 0
    for value, error in zip(values, errors, strict=True):
        if value.imag < 0:
            continue
        width = NORMAL * error if error > FLOAT32_ROUNDING else 0.0
        imaginary = f" ± {value.imag:.4g}i" if value.imag else ""
        known = f"{value.real:.4g}{imaginary} within {width:.2g}"
        words.append(known if width < WIDE else f"{value.real:.4g}{imaginary}, hardly known")
        open_ends += bool(abs(value) < 1 <= abs(value) + width)
    unsure = f" {open_ends} that decay in the model may be unstable in the plant, as far as the log"
    unsure = f"{unsure} shows." * bool(open_ends)
    return f"Poles with 95 % confidence, under {noise}: {'; '.join(words)}.{unsure}"


EXTRAPOLATED = 5.0  # spreads from the mean of the data beyond which a model is extrapolated


def operating_point(
    found: Regression, given: Sequence[Array | None], delays: Sequence[int]
) -> Array:
    """Return the steady state, inputs and disturbances (n+m+d,) of the fitted plant.

    ``given`` holds what is known of x, u and d, None where nothing is. So many of the last states
    as ``delays`` says are each input on its way: at rest these are the inputs.
    """
    n, m, _ = found.sizes
    means = zip(given, np.split(found.center, [n, n + m]), strict=True)
    start = np.concatenate([mean if value is None else value for value, mean in means])
    # The state gives way, or the inputs where the state is given; nothing where both are.
    if given[0] is not None and given[1] is not None:
        return start
    scale = np.where(found.spread > 0, found.spread, 1.0)
    moves = (found.coefficients - np.eye(n, scale.size)) * scale / scale[:n, None]
    doubt = found.standard_errors * scale / scale[:n, None]
    inputs = slice(n, n + m)

    def drift() -> Array:
        return np.asarray((found.predict(start[None])[0] - start[:n]) / scale[:n])

    if given[0] is not None:
        start[inputs] += scale[inputs] * _way(moves[:, inputs], drift(), doubt[:, inputs])
        return start
    if given[1] is None:  # only the inputs can hold an integrator
        left, _, _, known = _directions(moves[:, :n], doubt[:, :n])
        free = left[:, ~known].T
        errors = np.sqrt(free**2 @ doubt[:, inputs] ** 2)
        start[inputs] += scale[inputs] * _way(free @ moves[:, inputs], free @ drift(), errors)
    own = n - sum(delays)
    start[own:n] = np.repeat(start[inputs], delays)
    start[:own] += scale[:own] * _way(moves[:own, :own], drift()[:own], doubt[:own, :own])
    return np.where(np.abs(start) <= 1e-12 * scale, 0.0, start)  # no rounding


def _directions(moves: Array, doubt: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return the singular value decomposition, and which directions differ from an integrator."""
    left, sizes, right = np.linalg.svd(moves, full_matrices=False)
    errors = np.sqrt(np.sum((left.T**2 @ doubt**2) * right**2, axis=1))
    return left, sizes, right, (sizes > SURE_ERRORS * errors) & (sizes > 1e-9)


def _way(moves: Array, drift: Array, doubt: Array) -> Array:
    """Return the step to the steady state along the directions that the data determine."""
    left, sizes, right, known = _directions(moves, doubt)
    steps = -(left.T @ drift) / np.where(known, sizes, 1.0)
    return np.asarray(right.T @ np.where(known & (np.abs(steps) <= EXTRAPOLATED), steps, 0.0))
