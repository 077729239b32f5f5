"""Whether a log's inputs are those that acted: rows, columns, signs and units.

A log that was made by the law tells it by the law. In another one, an input that acted shows in the
next state as the given model says, in direction, sign and size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of
from sb3_yann.twin.dynamics import Coordinates, law_of
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Monomials

CLEARLY = 0.5
"""Another reading of a log is taken where it leaves less than so much of the error."""
NEARLY = 0.1
"""What the law leaves of an input, relative to its standard deviation, that it explains."""
FOLLOWS = 0.7
"""An input follows the law where the law leaves less than so much of its standard deviation."""
SAME = 0.05
"""How far an input may be from the law in scale: less is no other unit."""
EXACT = 0.02
"""What is left of an input, relative to its standard deviation, that is the law times a factor."""
GAINS = 1 / 3, 3.0
"""An identified gain beyond these times the model's is one in other units."""
SURE = 4.0
"""Standard errors by which a gain must be beyond them."""
LITTLE = 0.1
"""An effect of so much of the model's is none against its sign."""
OFFSET = 0.25
"""Half-widths: where a plant rests with an input so far from zero, that has another zero."""
FEW = 5
"""Rows for each coefficient of a regression, at least."""
WHERE = {-1: "the row before", 0: "the same row", 1: "the row after"}


def objections(
    problem: LinearMPC, coordinates: Coordinates, episodes: tuple[Episode, ...]
) -> list[str]:
    """Return what speaks against the rows, columns, signs or units of a log's inputs.

    Parameters
    ----------
    problem, coordinates : LinearMPC and Coordinates
        Of the twin.
    episodes : tuple of Episode
        The log.
    """
    compared = [_of_law(problem, coordinates, episodes, shift) for shift in (0, -1, 1)]
    logged, names = compared[0], labels_of(problem.model)[1]
    best = min(compared, key=lambda each: float(np.sum(each.assigned() ** 2)))
    others = np.min([each.left.min(axis=(1, 2)) for each in compared[1:]], axis=0)
    follows = (logged.straight < FOLLOWS) & (logged.straight <= others)
    if np.all(follows & (logged.straight < EXACT)):
        return []  # the law made it
    law = [*_against_law(best, logged, names)]
    if law and np.min(best.assigned()) < EXACT:
        return law
    states = [*_against_states(problem, coordinates, episodes)]
    said = states or [*_scaled(problem, coordinates, episodes, logged, names)] or law
    if said or np.all(follows):
        return said
    own = np.flatnonzero(~follows)
    return [*_against_model(problem, coordinates, episodes, own, names)]


@dataclass(frozen=True)
class _Law:
    """Inputs beside what the law says some rows away.

    Attributes
    ----------
    shift : int
    inputs, law : ndarray, shape (rows, m)
    left : ndarray, shape (m, m, 2)
        What column i of the law, with either sign, leaves of input j, in standard deviations of it.
    """

    shift: int
    inputs: Array
    law: Array
    left: Array

    @property
    def straight(self) -> Array:
        """What each column of the law leaves of its own input, (m,)."""
        return np.diagonal(self.left[..., 0])

    def columns(self) -> Array:
        """Return which column of the law each input follows best, each once, (m,)."""
        return np.asarray(linear_sum_assignment(self.left.min(axis=2) ** 2)[1])

    def assigned(self) -> Array:
        """Return what the best columns and signs leave of each input, (m,)."""
        return np.asarray(self.left.min(axis=2)[np.arange(len(self.left)), self.columns()])


def _of_law(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: tuple[Episode, ...],
    shift: int,
    states: Array | None = None,
) -> _Law:
    """Return the inputs beside the law, at states (n,) that a matrix (n, n) makes of the logged."""
    row, layout, law = coordinates.row, problem.layout, law_of(problem)
    inputs, answers = [], []
    for each in episodes:
        k = np.arange(1, len(each) - 1)
        theta = row.shown(each.thetas)[k + shift].copy()
        theta[:, layout.previous] = each.actions[k - 1][:, : layout.n_previous]
        if states is not None:
            theta[:, layout.state] = theta[:, layout.state] @ states.T
        inputs.append(each.actions[k])
        answers.append(law(theta))
    u, answer = np.concatenate(inputs), np.concatenate(answers)
    known = np.isfinite(answer).all(axis=1)
    u, answer = u[known], answer[known]
    if not len(u):
        return _Law(shift, u, answer, np.ones((*problem.R.shape, 2)))
    unit = np.maximum(np.std(u, axis=0), 1e-6 * problem.u_half)
    errors = u[:, :, None, None] - answer[:, None, :, None] * np.array([1.0, -1.0])
    left = np.sqrt(np.mean(errors**2, axis=0)) / unit[:, None, None]
    return _Law(shift, u, answer, left)


def _clearly(left: Array, than: Array) -> bool:
    """Return whether another reading explains nearly all of some input, and clearly better.

    Less would not do: where a plant follows its inputs slowly, so does minus the law.
    """
    return bool(np.any((left < NEARLY) & (left < CLEARLY * than - 1e-5)))


def _against_law(best: _Law, logged: _Law, names: list[str]) -> Iterator[str]:
    """Yield where the inputs are the law's of other rows or columns, or with the other sign."""
    columns, left = best.columns(), best.assigned()
    for j in range(len(names)):
        i, sign = int(columns[j]), int(np.argmin(best.left[j, columns[j]]))
        same = best.shift == 0 and i == j and sign == 0
        if same or not _clearly(left[j], logged.straight[j]):
            continue
        what = f"{'minus ' if sign else ''}what the MPC gives {names[i]} in {WHERE[best.shift]}"
        cures = ["move the inputs by a row"] if best.shift else []
        cures += ["exchange the columns"] if i != j else []
        cures += ["change the sign"] if sign else []
        late = " A controller that acts a sample late is dead time: PastInputs."
        yield (
            f"The logged {names[j]} is {what} ({100 * left[j]:.3g} % of its standard deviation "
            f"apart; {100 * logged.straight[j]:.3g} % from its own). In the log, "
            f"{' and '.join(cures)}.{late if best.shift == -1 else ''}"
        )


def _against_states(
    problem: LinearMPC, coordinates: Coordinates, episodes: tuple[Episode, ...]
) -> Iterator[str]:
    """Yield where two columns of the states are exchanged, or one has the other sign.

    Then the law gives the inputs from the states so changed, or the given model predicts them.
    """
    names, row, n = labels_of(problem.model)[0], coordinates.row, problem.model.n_states
    logged = _of_law(problem, coordinates, episodes, 0).straight
    x = np.concatenate([each.thetas[:-1] for each in episodes])
    u = np.concatenate([each.actions for each in episodes])
    after = np.concatenate([each.thetas[1:, row.state] for each in episodes])
    driven = np.concatenate([x, u], axis=1)

    def error(change: Array) -> float:
        rows = driven.copy()
        rows[:, row.state] = x[:, row.state] @ change.T
        left = after @ change.T - rows @ row.linear[row.state].T
        return float(np.sum((np.std(left, axis=0) / np.abs(change @ coordinates.units)) ** 2))

    before = error(np.eye(n))
    for i, j in combinations_with_replacement(range(n), 2):
        change = np.eye(n)
        change[[i, j]] = change[[j, i]] if i != j else -change[[i, i]]
        law = _of_law(problem, coordinates, episodes, 0, change).straight
        if not _clearly(law, logged) and not error(change) < CLEARLY**2 * before:
            continue
        what = f"{names[i]} and {names[j]} are exchanged" if i != j else f"{names[i]} is negated"
        yield (
            f"The log fits the MPC, or its model, clearly better where {what}: look at the columns "
            "and signs of the states."
        )


def _scaled(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: tuple[Episode, ...],
    logged: _Law,
    names: list[str],
) -> Iterator[str]:
    """Yield where inputs are the law's in other units.

    Another controller may be the law times a factor as well. Where there is one state that is all
    of it, the given model decides: in which units do the inputs move the plant as it says?
    """
    rows = np.concatenate([each.thetas[:-1] for each in episodes])
    u = np.concatenate([each.actions for each in episodes])
    after = np.concatenate([each.thetas[1:] for each in episodes])
    row = coordinates.row
    rest = (after - np.concatenate([rows, u], axis=1) @ row.linear.T)[:, row.state]
    B = row.linear[row.state, row.size :]
    for j, name in enumerate(names):
        given, law = logged.inputs[:, j], logged.law[:, j]
        deviation, spread = np.std(given), np.std(law)
        if not len(law) or spread < 1e-6 * problem.u_half[j] or not deviation:
            continue
        slope, offset = np.polyfit(law, given, 1)
        left = float(np.std(given - slope * law - offset) / deviation)
        error = left * deviation / spread / np.sqrt(len(law))
        if not abs(slope - 1) > SAME + SURE * error or not slope > SURE * error:
            continue
        moved = (u[:, j] - offset) / slope - u[:, j]
        steps = rest, rest - moved[:, None] * B[:, j]
        sizes = [np.sum((np.std(each, axis=0) / coordinates.units) ** 2) for each in steps]
        # One state times a factor is what any controller makes of it.
        moved_zero = abs(offset) > OFFSET * problem.u_half[j] and not problem.layout.has_constants
        unlikely = moved_zero or not sizes[0] < CLEARLY * sizes[1]
        certain = problem.model.n_states > 1 or unlikely
        if (left < EXACT and certain) or (left < CLEARLY and sizes[1] < sizes[0]):
            yield (
                f"The logged {name} is {slope:.4g} times what the MPC gives"
                f"{f', {offset:+.4g}' if abs(offset) > SAME * deviation else ''}: is it in other "
                "units? Log it in those of the problem, as the plant got it."
            )


def _against_model(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: tuple[Episode, ...],
    own: NDArray[np.intp],
    names: list[str],
) -> Iterator[str]:
    """Yield where inputs that do not follow the law act otherwise than the model says.

    Gains are those of a regression of the next state on state and inputs, with squares of the
    states where there are rows enough.
    """
    fits = {shift: _Gains.of(problem, coordinates, episodes, shift) for shift in (0, -1, 1)}
    fit = fits[0]
    if fit is None:
        return
    for shift in (-1, 1):
        other = fits[shift]
        if other is None or (shift == 1 and not _causes(other, fit, problem.model.B, coordinates)):
            continue
        ratio = other.left / fit.left
        if ratio.min() < CLEARLY and ratio.max() < 1 / FOLLOWS:
            yield (
                f"The next states follow the inputs of {WHERE[shift]} (they leave "
                f"{100 * ratio.min():.3g} % of what the inputs of the same row leave). Move the "
                "inputs by a row; if the plant acts so late, give the model its dead time."
            )
            return
    if not problem.layout.has_constants:
        yield from _resting(fit, coordinates, problem.u_half, names)
    yield from _against_gains(fit, problem.model.B, coordinates.units, own, names)


def _against_gains(
    fit: _Gains, B: Array, unit: Array, own: NDArray[np.intp], names: list[str]
) -> Iterator[str]:
    """Yield where columns of inputs act as others of B do, against its signs, or far otherwise."""
    columns = _exchanged(fit, B, unit)
    for j in own:
        if columns[j] != j:
            yield (
                f"The logged {names[j]} moves the plant as the model's {names[columns[j]]} does: "
                "exchange the columns of the log."
            )
    if np.any(columns != np.arange(len(columns))):
        return
    for j in own:
        weights = _weights(B[:, j], unit)
        if not np.any(weights):
            continue
        gain = float(weights @ fit.B[:, j])
        error = float(np.sqrt(max(float(weights @ fit.covariance @ weights), 0.0)) * fit.factors[j])
        if gain + SURE * error < 0 and gain < -LITTLE:
            yield (
                f"The logged {names[j]} moves the plant against the sign of the model's B "
                f"({gain:.3g} ± {error:.2g} times its effect). Compare its sign and rows."
            )
        elif not GAINS[0] < gain < GAINS[1] and SURE * error < abs(gain - 1):
            yield (
                f"The logged {names[j]} moves the plant {gain:.3g} ± {error:.2g} times as much as "
                "the model says: is it in other units, or a row off?"
            )


def _weights(b: Array, units: Array) -> Array:
    """Return weights (n,) that make 1 of a column of B, and of another one its relative gain."""
    size = float(np.sum((b / units) ** 2))
    return b / units**2 / size if size else np.zeros(len(b))


def _causes(after: _Gains, fit: _Gains, B: Array, coordinates: Coordinates) -> bool:
    """Return whether the inputs of the row after may be what moved the plant.

    Inputs that follow the state of their own row tell it, with the other sign: that is no cause.
    """
    columns = zip(B.T, after.B.T, strict=True)
    gains = [_weights(b, coordinates.units) @ found for b, found in columns]
    return bool(min(fit.follows) > FOLLOWS or min(gains) > GAINS[0])


def _resting(
    fit: _Gains, coordinates: Coordinates, u_half: Array, names: list[str]
) -> Iterator[str]:
    """Yield where the plant rests at zero states with inputs far from zero."""
    drift, error = fit.drift / coordinates.units, fit.drift_error / coordinates.units
    B = fit.B / coordinates.units[:, None]
    rest = -np.linalg.lstsq(B, drift, rcond=None)[0]
    explained = np.linalg.norm(drift + B @ rest) < CLEARLY * np.linalg.norm(drift)
    if not explained or not np.any(np.abs(drift) > SURE * error):
        return
    for j in np.flatnonzero(np.abs(rest) > OFFSET * u_half):
        yield (
            f"At x = 0 the logged plant rests with {names[j]} = {rest[j]:.4g}, the problem's with "
            "0: compare the input's units and operating point; an absolute log needs absolute=True."
        )


@dataclass(frozen=True)
class _Gains:
    """A regression of the next states on states and inputs.

    Attributes
    ----------
    B : ndarray, shape (n, m)
    covariance : ndarray, shape (n, n)
        Of what it leaves.
    factors : ndarray, shape (m,)
        Standard errors of a column of B over the deviation of what is left.
    left : ndarray, shape (n,)
        Mean squares of that.
    drift, drift_error : ndarray, shape (n,)
        The next state of x = 0 and u = 0, and its standard error.
    follows : ndarray, shape (m,)
        What the states leave of the inputs, in standard deviations of these.
    """

    B: Array
    covariance: Array
    factors: Array
    left: Array
    drift: Array
    drift_error: Array
    follows: Array

    @classmethod
    def of(
        cls,
        problem: LinearMPC,
        coordinates: Coordinates,
        episodes: tuple[Episode, ...],
        shift: int,
    ) -> _Gains | None:
        """Return the regression on the inputs some rows away; None where there are few rows."""
        row, m = coordinates.row, problem.model.n_inputs
        steps = [(e, np.arange(1, len(e) - 1)) for e in episodes]
        z = np.concatenate(
            [row.features(e.thetas[k], e.actions[k + shift]) / coordinates.scale for e, k in steps]
        )
        y = np.concatenate([e.thetas[k + 1, row.state] for e, k in steps])
        states = Monomials(z.shape[1] - m, 2).values(z[:, :-m])
        many = len(z) > FEW * (states.shape[1] + m + 1)
        kept = states if many else z[:, :-m]
        F = np.column_stack([z[:, -m:], np.ones(len(z)), kept])
        if len(z) <= FEW * F.shape[1]:
            return None
        deviation = np.maximum(np.std(F, axis=0), 1e-300)
        left, singular, right = np.linalg.svd(F / np.where(deviation > 1e-12, deviation, 1), False)
        kept_ones = singular > 1e-7 * singular[0]
        inverse = np.where(kept_ones, 1 / np.maximum(singular, 1e-300), 1e7 / singular[0])
        scale = np.where(deviation > 1e-12, deviation, 1)
        slopes = (right.T * inverse * kept_ones) @ (left.T @ y) / scale[:, None]
        rest = y - F @ slopes
        freedom = len(z) - F.shape[1]
        unit = coordinates.units
        covariance = rest.T @ rest / freedom + np.diag((1e-5 * unit) ** 2)
        factors = np.linalg.norm(right.T * inverse, axis=1) / scale
        inputs = coordinates.scale[-m:]
        u, closed = F[:, :m], F[:, m:]
        feedback = u - closed @ np.linalg.lstsq(closed, u, rcond=None)[0]
        follows = np.std(feedback, axis=0) / np.maximum(deviation[:m], 1e-12)
        effects = slopes[:m].T / inputs, covariance, factors[:m] / inputs
        squares = np.diag(covariance).copy()
        return cls(*effects, squares, slopes[m], np.sqrt(squares) * factors[m], follows)


def _exchanged(fit: _Gains, B: Array, units: Array) -> NDArray[np.intp]:
    """Return whose direction of the model's B each input has (m,), in units of the states.

    Its own, unless others clearly fit better.
    """
    own: NDArray[np.intp] = np.arange(B.shape[1], dtype=np.intp)
    sizes = np.linalg.norm(fit.B / np.sqrt(np.diag(fit.covariance))[:, None], axis=0)
    if len(own) == 1 or np.any(SURE * np.sqrt(len(B)) * fit.factors > sizes):
        return own  # too little is known
    found, given = (each / units[:, None] for each in (fit.B, B))
    norms = np.outer(np.linalg.norm(found, axis=0), np.linalg.norm(given, axis=0))
    apart = 1 - (found.T @ given / np.maximum(norms, 1e-300)) ** 2
    columns = np.asarray(linear_sum_assignment(apart)[1], dtype=np.intp)
    clearly = apart[own, columns].sum() < CLEARLY**2 * apart[own, own].sum()
    return columns if clearly else own
