"""Whether the inputs and states of a log are those of the plant: rows, columns, signs and units.

Two regressions tell. An input of the MPC, regressed on the law, has slope one and offset zero: then
it is proven, whatever the plant's gain, and another slope is a fault of the log where the model
predicts better without it. Where the law does not explain an input, the next states, regressed on
states and inputs, show in which row, direction and size it acts. A gain beyond 0.6 and 1.7 times
the model's looks like other units, and must be confirmed by whoever knows the plant.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, linear_sum_assignment

from sb3_yann._validation import Array
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.dynamics import Coordinates, law_of
from sb3_yann.twin.log import Episode
from sb3_yann.twin.selection import basis

STANDARD_ERRORS = 4.0  # so far from a value a coefficient of a regression differs from it
CLEARLY_BETTER = 0.25  # share of the squared error that another reading of a log leaves at most
EXACT_SHARE = 4e-4  # of an input's variance: a regression that leaves less explains all of it
SLOPE_TOLERANCE = 0.1  # from one, of an input on the law: sensors' noise lowers the slope
LEAST_GAIN = 0.6  # times the model's: a gain below, or above the inverse, must be confirmed
MUCH_BETTER = 0.8  # share of the model's squared error that a unit's factor leaves at most
PACES = 1, 2, 3, 4, 5  # so many samples of the model may lie between two rows
LEAST_ROWS = 20  # rows of a regression on the law, at least
CONFIRM = (
    "If its units were checked, and the plant or its controller is so: "
    "PlantTwin.fit(..., units_confirmed=True)."
)
ROW_NAMES = {-1: "the row before", 0: "the same row", 1: "the row after"}


class Logged:
    """What is checked: rows (N, size), inputs (N, m), and the states after them (N, n)."""

    def __init__(
        self, coordinates: Coordinates, episodes: tuple[Episode, ...], units_confirmed: bool = False
    ) -> None:
        self.row = coordinates.row
        self.problem = self.row.problem
        self.unit = coordinates.units
        self.scale = coordinates.scale
        self.episodes = episodes
        self.units_confirmed = units_confirmed
        self.rows = np.concatenate([each.thetas[:-1] for each in episodes])
        self.inputs = np.concatenate([each.actions for each in episodes])
        self.after = np.concatenate([each.thetas[1:, self.row.state] for each in episodes])
        self.names = labels_of(self.problem.model)
        self.act = law_of(self.problem)

    @cached_property
    def made_by_law(self) -> NDArray[np.bool_]:
        """Which inputs (m,) are the MPC's own in enough rows, in which it moves: in its units."""
        # 1e-3: how far an input may be from the MPC's own, in half-widths
        room = 1e-3 * self.problem.u_half
        own = self.problem.deviations
        law = self.act(self.row.shown(self.rows))
        inside = (law > own.u_min + room) & (law < own.u_max - room)
        same = inside & (np.abs(self.inputs - law) <= room)
        # 0.2: share of the rows, where the law is inside of its bounds, that it has made
        found = same.sum(axis=0) >= np.maximum(LEAST_ROWS, 0.2 * inside.sum(axis=0))
        for j in np.flatnonzero(found):
            moves = np.std(law[same[:, j], j])
            found[j] = moves > max(10 * room[j], 0.5 * np.std(law[inside[:, j], j]))
        return np.asarray(found)

    @cached_property
    def excitation(self) -> Array:
        """How much of each input's variance (m,) neither the MPC nor a line in theta explains."""
        theta = self.row.shown(self.rows).copy()
        layout = self.problem.layout
        given = np.r_[layout.reference, layout.limits]
        theta[:, given] = theta[:, given].mean(axis=0)  # what set-points move is excitation
        known = np.delete(theta, layout.previous, axis=1)  # a test that is held follows itself
        columns = np.column_stack([np.ones(len(theta)), known, self.act(theta)])
        left = self.inputs - columns @ np.linalg.lstsq(columns, self.inputs, rcond=None)[0]
        variance = np.var(self.inputs, axis=0)
        return np.where(variance > 0, np.var(left, axis=0) / np.maximum(variance, 1e-300), 0.0)

    def on_law(self, shift: int = 0) -> tuple[Array, Array]:
        """Return rows of theta (N, n_theta), ``shift`` away from the inputs (N, m) beside them."""
        layout = self.problem.layout
        thetas = []
        inputs = []
        for each in self.episodes:
            k = np.arange(1, len(each) - 1)
            theta = self.row.shown(each.thetas)[k + shift].copy()
            theta[:, layout.previous] = each.actions[k - 1][:, : layout.n_previous]
            thetas.append(theta)
            inputs.append(each.actions[k])
        return np.concatenate(thetas), np.concatenate(inputs)

    def errors(self, change: Array, shift: Any = 0.0, inputs: Array | None = None) -> Array:
        """Return how far the given model errs (N, n) where states x are ``change x + shift``."""
        rows = np.concatenate([self.rows, self.inputs if inputs is None else inputs], axis=1)
        rows[:, self.row.state] = self.rows[:, self.row.state] @ change.T + shift
        left = self.after @ change.T + shift - rows @ self.row.linear[self.row.state].T
        return np.asarray(left / np.abs(change @ self.unit))


def objections(log: Logged) -> list[str]:
    """Return what speaks against the rows, columns, signs or units of a log."""
    readings = {s: _on_law(log, s) for s in ROW_NAMES}
    logged = np.diagonal(readings[0].left)
    proven = np.diagonal(readings[0].as_it_is).copy()
    exact = log.made_by_law.copy()  # a plant at rest repeats its inputs: so it seems amid any row
    for s in (-1, 1):
        clearly = np.diagonal(readings[s].left) < CLEARLY_BETTER * logged - 1e-9
        other = clearly & np.diagonal(readings[s].as_it_is & readings[s].alone)
        proven &= ~other
        exact &= ~other
    found = [] if log.units_confirmed else [*_other_pace(log)]
    if np.all(exact | (proven & (logged < EXACT_SHARE))):
        return found
    proven |= exact
    found += [*_against_law(log, readings, proven), *_against_states(log, logged, proven)]
    if not found and not log.units_confirmed:
        found += _other_units(log, readings[0], proven)
    return found or [*_against_plant(log, proven)]


class _OnLaw(NamedTuple):
    """Each logged input j regressed on each column i of the law, some rows away, at [i, j].

    Errors are four standard errors. The regression leaves a share ``left`` of the input's variance,
    and would leave ``left_of_rows`` with theta besides, were all that it adds chance. ``unique``
    (m,): the law is more than a multiple of one entry of theta.
    """

    slope: Array
    offset: Array
    error: Array
    offset_error: Array
    left: Array
    left_of_rows: Array
    unique: NDArray[np.bool_]

    @property
    def alone(self) -> NDArray[np.bool_]:
        """Where the law explains an input, and theta adds nothing to it, (m, m)."""
        # 0.7: the most of an input's variance that a dither on top of the law may be
        made = (self.left < self.left_of_rows + EXACT_SHARE) & (self.left < 0.7)
        return (made & self.unique[:, None]) | (self.left < EXACT_SHARE)

    @property
    def as_it_is(self) -> NDArray[np.bool_]:
        """Where column i of the law gives input j as it is, in no other unit, (m, m)."""
        near = (np.abs(self.slope - 1) < SLOPE_TOLERANCE) & (self.error < 1 - LEAST_GAIN)
        return near & (np.abs(self.offset) < self.offset_error)


def _on_law(log: Logged, shift: int, change: tuple[Array, Array] | None = None) -> _OnLaw:
    """Return the regressions on the law at the rows ``shift`` away, of M x + v by ``change``."""
    m = log.problem.model.n_inputs
    theta, u = log.on_law(shift)
    if change is not None:
        state = log.problem.layout.state
        theta[:, state] = theta[:, state] @ change[0].T + change[1]
    answer = log.act(theta)
    known = np.isfinite(answer).all(axis=1)
    theta, u, answer = (each[known] for each in (theta, u, answer))
    slope, offset, offset_error = np.zeros((3, m, m))
    error, left, left_of_rows = np.ones((3, m, m))
    error *= STANDARD_ERRORS
    unique = np.zeros(m, dtype=bool)
    own = log.problem.deviations
    for i in range(m):
        inside = np.minimum(answer[:, i] - own.u_min[i], own.u_max[i] - answer[:, i])
        inside = inside > 1e-3 * log.problem.u_half[i]
        y, a, x = (each[inside] for each in (u, answer[:, i], theta))
        if len(a) < LEAST_ROWS or np.std(a) < 1e-6 * log.problem.u_half[i]:
            continue
        x = x[:, np.std(x, axis=0) > 1e-9 * log.problem.theta_half]
        F = np.column_stack([a - a.mean(), np.ones(len(a))])
        rows = np.column_stack([F, (x - x.mean(axis=0)) / np.std(x, axis=0)])
        spread = np.maximum(np.var(y, axis=0), 1e-12 * log.problem.u_half**2)
        slope[i], mean = np.linalg.lstsq(F, y, rcond=None)[0]
        offset[i] = mean - slope[i] * a.mean()
        left[i] = np.mean((y - F @ [slope[i], mean]) ** 2, axis=0) / spread
        rest = y - rows @ np.linalg.lstsq(rows, y, rcond=1e-9)[0]
        # An F test: p columns that say nothing explain p of N rows.
        left_of_rows[i] = (1 + 3 * x.shape[1] / len(a)) * np.mean(rest**2, axis=0) / spread
        sure = STANDARD_ERRORS * np.sqrt(left[i] * spread / len(a))
        error[i] = sure / np.std(a)
        # Of one entry of theta every linear controller is the law times a factor.
        share = x - F @ np.linalg.lstsq(F, x, rcond=None)[0]
        unique[i] = np.any(np.var(share, axis=0) > 0.02 * np.var(x, axis=0))
        noise = SLOPE_TOLERANCE * np.sqrt(spread)
        offset_error[i] = noise + sure * np.sqrt(np.mean(a**2) / np.var(a))
    return _OnLaw(slope, offset, error, offset_error, left, left_of_rows, unique)


def _against_law(
    log: Logged, readings: dict[int, _OnLaw], proven: NDArray[np.bool_]
) -> Iterator[str]:
    """Yield where an input is the law's of other rows or columns, or in other units."""
    names = log.names[1]
    for j in np.flatnonzero(~proven):
        own = readings[0].left[j, j]
        found = [
            (float(on.left[i, j]), s, i)
            for s, on in readings.items()
            for i in np.flatnonzero(on.alone[:, j])
            if (s == 0 and i == j) or on.left[i, j] < CLEARLY_BETTER * own - 1e-9
        ]
        if not found:
            continue
        _, s, i = min(found)
        slope = readings[s].slope[i, j]
        cures = ["move the inputs by a row"] if s else []
        cures += ["exchange the columns"] if i != j else []
        cures += ["change the sign"] if slope < 0 else []
        if cures and abs(abs(slope) - 1) < SLOPE_TOLERANCE + readings[s].error[i, j]:
            late = " A controller that acts a sample late is dead time: PastInputs."
            yield (
                f"The logged {names[j]} is {'minus ' if slope < 0 else ''}what the MPC gives "
                f"{names[i]} in {ROW_NAMES[s]} (it leaves "
                f"{100 * np.sqrt(readings[s].left[i, j]):.3g} % of its deviation; its own leaves "
                f"{100 * np.sqrt(own):.3g} %). In the log, "
                f"{' and '.join(cures)}.{late if s == -1 else ''}"
            )


def _against_states(log: Logged, logged: Array, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield where law or model fit the states with two columns exchanged, or one negated."""
    n = log.problem.model.n_states
    names = log.names[0]

    def error(change: Array) -> Array:
        return np.asarray(np.var(log.errors(change), axis=0)) + 1e-12

    before = error(np.eye(n))
    for i, j in combinations_with_replacement(range(n), 2):
        change = np.eye(n)
        change[[i, j]] = change[[j, i]] if i != j else -change[[i, i]]
        ratio = error(change) / (np.abs(change) @ before)
        fits = ratio.min() < CLEARLY_BETTER and ratio.max() < 1.5
        if not fits and not np.all(proven):
            on = _on_law(log, 0, (change, np.zeros(n)))
            better = np.diagonal(on.left) < CLEARLY_BETTER * logged - 1e-9
            fits = np.any(np.diagonal(on.as_it_is & on.alone) & better & ~proven)
        if fits:
            what = f"and {names[j]} are exchanged" if i != j else "is negated"
            yield (
                f"The log fits the MPC, or its model, clearly better where {names[i]} {what}: look "
                "at the columns and signs of the states."
            )


def _other_units(log: Logged, logged: _OnLaw, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield which inputs, or which state instead, in another unit or with another zero are the law.

    A law that is nearly linear takes the zero of one for another's: the model tells them apart, or
    all are named. Where it predicts no better so, another controller wrote the log.
    """
    names = log.names
    n = log.problem.model.n_states

    def left_by_model(change: Array, shift: Array, u: Array) -> float:
        return float(np.mean(log.errors(change, shift, u) ** 2))

    found: list[tuple[float, str]] = []
    of_inputs = []
    read = log.inputs.copy()
    for j in np.flatnonzero(~proven & np.diagonal(logged.alone)):
        slope, error, away, known = (
            each[j, j] for each in (logged.slope, logged.error, logged.offset, logged.offset_error)
        )
        away = away if abs(away) > known else 0.0
        if abs(slope) > error and (abs(slope - 1) > SLOPE_TOLERANCE + error or away):
            zero = f", {away:+.4g}" if away else ""
            of_inputs.append(
                f"The logged {names[1][j]} is {slope:.4g} times what the MPC gives{zero}"
            )
            read[:, j] = (log.inputs[:, j] - away) / slope
    if of_inputs:
        found = [(left_by_model(np.eye(n), np.zeros(n), read), " and ".join(of_inputs))]
    theta, u = log.on_law()
    some = np.linspace(0, len(u) - 1, min(len(u), 300)).astype(int)  # an online law takes its time
    theta, u = (each[some] for each in (theta, u))
    scale = np.maximum(np.std(u, axis=0), 1e-6 * log.problem.u_half)
    for i in range(n) if not proven.all() else ():

        def left(p: Array, i: int = i) -> Array:
            rows = theta.copy()
            rows[:, i] = p[0] * rows[:, i] + p[1] * log.unit[i]
            return np.asarray(np.nan_to_num((u - log.act(rows)) / scale).ravel())

        before = np.mean(left(np.array([1.0, 0.0])) ** 2)
        fit = least_squares(left, [1.0, 0.0], diff_step=1e-4, max_nfev=20)
        factor, zero = fit.x
        moved = abs(np.log(max(abs(factor), 1e-9))) > 2 * SLOPE_TOLERANCE or abs(zero) > 0.2
        if not moved or not np.mean(fit.fun**2) < 0.5 * before:
            continue
        change = np.eye(n)
        change[i, i] = factor
        shift = zero * log.unit[i] * np.eye(n)[i]
        on = _on_law(log, 0, (change, shift))
        if np.any(np.diagonal(on.as_it_is & on.alone) & ~proven):
            times = f"{factor:.4g} times " if abs(factor - 1) > 0.01 else ""
            words = f"The MPC gives the logged inputs where {names[0][i]} is {times}what is logged"
            found.append((left_by_model(change, shift, log.inputs), f"{words}, {shift[i]:+.4g}"))
    as_it_is = left_by_model(np.eye(n), np.zeros(n), log.inputs)
    found = [(error, words) for error, words in found if error < as_it_is]
    least = min((error for error, _ in found), default=0.0)
    if readings := [words for error, words in found if CLEARLY_BETTER * error <= least]:
        yield f"{'; or: '.join(readings)}: is it in other units, or has it another zero? {CONFIRM}"


def _other_pace(log: Logged) -> Iterator[str]:
    """Yield where the states move as the model's do in several samples, with any gain and zero."""
    model = log.problem.model
    x = log.rows[:, log.row.state]
    m = model.n_inputs
    power: Array = np.eye(model.n_states)
    driven: Array = np.zeros_like(model.B)
    left = []
    for _ in PACES:
        driven = driven + power @ model.B
        power = model.A @ power
        rest = (log.after - x @ power.T) / log.unit
        rest -= rest.mean(axis=0)
        u = (log.inputs - log.inputs.mean(axis=0))[:, None] * (driven / log.unit[:, None])
        gains = np.linalg.lstsq(u.reshape(-1, m), rest.ravel(), rcond=1e-9)[0]
        # An input that moves by less than 1e-9 of a half-width stands still.
        left.append(np.var(rest - u @ gains, axis=0) + 1e-9)
    ratio = np.array(left) / left[0]
    best = int(np.argmin(ratio.mean(axis=1)))
    if ratio[best].min() < CLEARLY_BETTER and ratio[best].max() < 1.5:
        yield (
            f"From row to row the states move as the model's do in {PACES[best]} samples: are "
            f"rows missing, or is dt = {model.dt:g} another plant's? {CONFIRM}"
        )


def _against_plant(log: Logged, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield where inputs that the law does not prove act otherwise than the model says."""
    if words := _by_innovations(log):
        yield words
        return
    if (fit := _Effects.of(log, 0)) is None:
        return
    B = log.problem.model.B / log.unit[:, None]
    sizes = np.maximum(np.sum(B**2, axis=0), 1e-300)
    weights = (B / log.unit[:, None] / sizes).T  # they make 1 of a column of B
    for s in (-1, 1):
        if (other := _Effects.of(log, s)) is None:
            continue
        # Inputs that follow the state of their own row tell it, with the other sign: no cause.
        caused = other.follows.min() > 0.7 or np.min(np.sum(weights * other.B.T, axis=1)) > 1 / 3
        ratio = np.diag(other.covariance) / np.diag(fit.covariance)
        if (s == -1 or caused) and ratio.min() < 0.5 and ratio.max() < 1.5:
            yield f"The next states follow {_moved(s, ratio.min())}"
            return
    yield from _against_gains(log, fit, weights, proven)
    driven = fit.follows.min() > 0.7 and not np.any(proven)  # in closed loop noise moves the zero
    if driven and not (log.problem.layout.has_constants or log.units_confirmed):
        yield from _resting(log, fit)


def _by_innovations(log: Logged) -> str:
    """Return in which other row, or with which other sign, an estimator needs the inputs.

    Its innovations are those of the log, less what a linear filter makes of the inputs' change.
    """
    estimator = log.row.estimator
    if estimator is None or np.any(estimator.every > 1):
        return ""
    seen = estimator.gain[: log.unit.size]
    if np.linalg.matrix_rank(seen) < len(estimator.C):
        return ""
    errors = []
    for each in log.episodes:
        theta = log.row.shown(each.thetas)
        left = theta[1:] - log.problem.deviations.predict(theta[:-1], each.actions)
        errors.append(left[1:-1, log.problem.layout.state] @ np.linalg.pinv(seen).T)
    e = np.concatenate(errors)

    def shown(changes: list[Array]) -> Array:  # what so much more input adds to innovations (N, q)
        found = []
        for change in changes:
            z = np.zeros(len(estimator.A))
            for u in change:
                z = estimator.A @ z + estimator.B @ u
                found.append(estimator.C_aug @ z)
                z -= estimator.gain @ found[-1]
        return np.array(found)

    inputs = [each.actions for each in log.episodes]
    for s in (-1, 1):
        moved = shown([u[1 + s : len(u) - 1 + s] - u[1:-1] for u in inputs])
        ratio = np.var(e - moved, axis=0) / np.maximum(np.var(e, axis=0), 1e-300)
        if ratio.min() < 0.5 and ratio.max() < 1.5:
            return f"The outputs follow {_moved(s, ratio.min())}"
    constant = [np.ones_like(u) for u in inputs]  # of inputs that count from elsewhere
    each_input = np.eye(inputs[0].shape[1])
    columns = [shown([u[1:-1] * on for u in of]) for of in (inputs, constant) for on in each_input]
    scale = np.maximum(e.std(axis=0), 1e-300)
    F = (np.array(columns) / scale).reshape(len(columns), -1).T
    y = (e / scale).ravel()
    found = np.linalg.lstsq(F, y, rcond=1e-9)[0]
    left = np.var(y - F @ found)
    wide = STANDARD_ERRORS * np.sqrt(left * np.abs(np.diag(np.linalg.pinv(F.T @ F))))
    for j, name in enumerate(log.names[1]):
        gain = 1 + found[j]
        if gain < -0.1 - wide[j] and left < MUCH_BETTER * np.var(y):
            return _against_sign(name, f"{gain:.3g} ± {wide[j]:.2g} times")
    return ""


def _against_sign(name: str, measured: str) -> str:
    return (
        f"The logged {name} moves the plant against the sign of the model's B ({measured} its "
        "effect). Compare its sign (is a valve logged as closed, not open?), its column and rows."
    )


def _moved(s: int, ratio: float) -> str:
    return (
        f"the inputs of {ROW_NAMES[s]} (they leave {100 * ratio:.3g} % of what the inputs of the "
        "same row leave). Move the inputs by a row; if the plant acts so late, give the model its "
        "dead time."
    )


def _against_gains(
    log: Logged, fit: _Effects, weights: Array, proven: NDArray[np.bool_]
) -> Iterator[str]:
    """Yield where inputs act as others of B do, against its signs, or far otherwise."""
    names = log.names[1]
    own = np.arange(len(weights))
    B = log.problem.model.B
    found, given = (each / log.unit[:, None] for each in (fit.B, B))
    norms = np.outer(np.linalg.norm(found, axis=0), np.linalg.norm(given, axis=0))
    apart = 1 - (found.T @ given / np.maximum(norms, 1e-300)) ** 2
    columns = linear_sum_assignment(apart)[1]
    sizes = np.linalg.norm(fit.B / np.sqrt(np.diag(fit.covariance))[:, None], axis=0)
    known = np.all(sizes > STANDARD_ERRORS * np.sqrt(len(B)) * fit.factors)
    others = np.flatnonzero((columns != own) & ~proven)
    better = apart[own, columns].sum() < CLEARLY_BETTER * apart[own, own].sum()
    if known and better and len(others):
        for j in others:
            yield (
                f"The logged {names[j]} moves the plant as the model's {names[columns[j]]} does: "
                "exchange the columns of the log."
            )
        return
    for j in np.flatnonzero(~proven & np.any(B, axis=0)):
        gain = float(weights[j] @ fit.B[:, j])
        variance = float(weights[j] @ fit.covariance @ weights[j])
        error = STANDARD_ERRORS * float(np.sqrt(max(variance, 0.0)) * fit.factors[j])
        measured = f"{gain:.3g} ± {error:.2g} times"
        # Units make the model better; where they do not, the gain is curvature.
        read = np.where(own == j, gain, 1.0) * log.inputs
        errors = (log.errors(np.eye(len(B)), inputs=u) for u in (read, log.inputs))
        left, before = (np.var(each, axis=0).sum() for each in errors)
        far = not LEAST_GAIN < gain < 1 / LEAST_GAIN and abs(gain - 1) > error
        if gain + error < 0 and gain < -0.1:
            yield _against_sign(names[j], measured)
        elif far and left < MUCH_BETTER * before and not log.units_confirmed:
            yield (
                f"The logged {names[j]} moves the plant {measured} as much as the model says: "
                f"is it in other units, or a row off? {CONFIRM}"
            )


def _resting(log: Logged, fit: _Effects) -> Iterator[str]:
    """Yield where the plant moves at x = 0 and u = 0, and so rests elsewhere."""
    if not np.any(np.abs(fit.drift) > STANDARD_ERRORS * fit.drift_error):
        return
    rest = _rest_of(log)
    away = np.abs(rest / log.unit)
    shown = log.problem.units.to_plant(rest)
    elsewhere = [
        f"{log.names[0][i]} = {shown[i]:.4g}, the problem's at {log.problem.model.x_ss[i]:.4g}"
        for i in np.flatnonzero(away > 0.5)
    ]
    if elsewhere and np.max(away) <= 5:  # beyond the log: a state that hardly returns, or noise
        there = ", ".join(f"{each:.5g}" for each in shown)
        yield (
            f"With inputs at u_ss the logged plant rests at {'; '.join(elsewhere)}: compare units "
            "and operating point of states and inputs. If the plant is not linear, fit the twin of "
            f"mpc = replace(mpc, model=replace(mpc.model, x_ss=[{there}])), with "
            f"dataclasses.replace. {CONFIRM}"
        )


def _rest_of(log: Logged) -> Array:
    """Return the state (n,) at which the plant rests, or hardly moves, with u = 0.

    It is that of a regression, on products as well where rows are enough; rows nearby count more.
    """
    unit = log.unit
    n = unit.size
    z = log.row.features(log.rows, log.inputs) / log.scale
    y = log.after / unit
    curved = basis(z, False, 2)
    F = np.column_stack([np.ones(len(z)), curved if len(z) > 5 * (curved.shape[1] + 1) else z])
    spread = z.std(axis=0)
    spread[spread == 0] = 1.0

    def features(x: Array) -> Array:
        return np.append(x * unit / log.scale[:n], np.zeros(z.shape[1] - n))

    def motion(x: Array) -> Array:
        terms = basis(features(x)[None], False, 2)[0]
        return np.asarray(weights[0] + terms[: F.shape[1] - 1] @ weights[1:] - x)

    x: Array = np.zeros(n)
    for _ in range(5):
        near = np.exp(-np.mean(((z - features(x)) / spread) ** 2, axis=1) / 2)[:, None]
        weights = np.linalg.lstsq(near * F, near * y, rcond=1e-9)[0]
        x = least_squares(motion, x).x
    return np.asarray(unit * x)


class _Effects(NamedTuple):
    """A regression of the next states on states and inputs: B (n, m), and what it leaves.

    ``factors`` (m,) are standard errors of a column of B over the deviation of what is left,
    ``drift`` (n,) is the next state of x = 0 and u = 0, ``follows`` (m,) the deviation of the
    inputs that the states leave, relative to their own.
    """

    B: Array
    covariance: Array
    factors: Array
    drift: Array
    drift_error: Array
    follows: Array

    @classmethod
    def of(cls, log: Logged, shift: int) -> _Effects | None:
        """Return the regression on the inputs some rows away; None where there are few rows."""
        row = log.row
        m = log.problem.model.n_inputs
        steps = [(e, np.arange(1, len(e) - 1)) for e in log.episodes]
        z = np.concatenate([row.features(e.thetas[k], e.actions[k + shift]) for e, k in steps])
        y = np.concatenate([e.thetas[k + 1, row.state] for e, k in steps])
        x, u = np.split(z / log.scale, [-m], axis=1)
        curved = basis(x, False, 2)  # where rows are enough
        states = curved if len(z) > 5 * (curved.shape[1] + m + 1) else x
        F = np.column_stack([u, np.ones(len(z)), states])
        if len(z) <= 5 * F.shape[1]:
            return None
        scale = np.std(F, axis=0)
        scale[scale < 1e-12] = 1.0
        gram = (F / scale).T @ (F / scale)
        # Inputs that are linear in the states have no effect of their own, and a large error.
        inverse = np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)))
        slopes = inverse @ (F / scale).T @ y / scale[:, None]
        rest = y - F @ slopes
        covariance = rest.T @ rest / (len(z) - F.shape[1]) + np.diag((1e-5 * log.unit) ** 2)
        factors = np.sqrt(np.diag(inverse)) / scale
        own = u - F[:, m:] @ np.linalg.lstsq(F[:, m:], u, rcond=None)[0]
        follows = np.std(own, axis=0) / np.maximum(np.std(u, axis=0), 1e-12)
        size = log.scale[-m:]
        drift = slopes[m], np.sqrt(np.diag(covariance)) * factors[m]
        return cls(slopes[:m].T / size, covariance, factors[:m] / size, *drift, follows)
