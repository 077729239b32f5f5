"""Whether the inputs and states of a log are those of the plant: rows, columns, signs and units.

Two regressions tell. Where the MPC made the log, an input regressed on what the law gives has slope
one and offset zero: then it is proven, whatever the plant's gain. Any other slope of a log that the
law explains is a fault of the log. Where the law does not explain an input, only the plant can
speak: the next states, regressed on states and inputs, show in which row, direction and size it
acts. A plant whose gain is not the model's looks like an input in other units; a gain beyond
0.6 and 1.7 times the model's must be confirmed by whoever knows the plant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, linear_sum_assignment

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.dynamics import Coordinates, law_of
from sb3_yann.twin.log import Episode

STANDARD_ERRORS = 4.0
"""A coefficient of a regression differs from a value where it is farther away than so many."""
CLEARLY_BETTER = 0.25
"""Another reading of a log counts where it leaves less than so much of the squared error."""
EXACT_SHARE = 4e-4
"""A regression that leaves less of an input's variance explains all of it: 2 % of its deviation."""
DITHERED_SHARE = 0.7  # the most of an input's variance that a dither on top of the law may be
SLOPE_TOLERANCE = 0.1
"""How far from one the slope of an input on the law may be: sensors' noise lowers it."""
LEAST_GAIN = 0.6
"""A gain below so many times the model's, or above the inverse, must be confirmed by the user."""
RUN = 10
MUCH_BETTER = 0.8
"""Steps of a run of the model; share of its squared error that a unit's factor leaves at most."""
ROUNDING = 1e-9  # of a half-width: an input that moves by less stands still
MOVING = 1e-3  # of a standard deviation: a state that moves by more in a step moves
PACES = 1, 2, 3, 4, 5  # so many samples of the model may lie between two rows
LEAST_ROWS = 20  # rows of a regression on the law, at least
LAW = 1e-3  # how far an input may be from the MPC's own, in half-widths
PROVING = 0.2  # share of the rows, where the law is inside of its bounds, that it has made
CONFIRM = (
    "If its units were checked, and the plant or its controller is so: "
    "PlantTwin.fit(..., units_confirmed=True)."
)
ROW_NAMES = {-1: "the row before", 0: "the same row", 1: "the row after"}


class _Log(NamedTuple):
    """What is checked: see :func:`objections`."""

    problem: LinearMPC
    coordinates: Coordinates
    episodes: tuple[Episode, ...]
    units_confirmed: bool


def objections(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: tuple[Episode, ...],
    units_confirmed: bool = False,
) -> list[str]:
    """Return what speaks against the rows, columns, signs or units of a log.

    Where its units are confirmed another gain, zero or pace than the model's is the plant's own,
    and another law is another controller's.
    """
    log = _Log(problem, coordinates, episodes, units_confirmed)
    readings = {s: _on_law(log, s) for s in ROW_NAMES}
    logged = np.diagonal(readings[0].left)
    proven = np.diagonal(_is_one(readings[0])).copy()
    for s in (-1, 1):
        clearly = np.diagonal(readings[s].left) < CLEARLY_BETTER * logged - 1e-9
        proven &= ~(clearly & np.diagonal(_is_one(readings[s]) & readings[s].alone))
    found = [] if units_confirmed else [*_other_pace(log)]
    exact = made_by_law(problem, episodes)
    if np.all(exact | (proven & (logged < EXACT_SHARE))):
        return found
    proven |= exact
    found += [*_against_law(log, readings, proven), *_against_states(log, logged, proven)]
    if not found and not units_confirmed:
        found += _other_units(log, readings[0], proven)
    return found or [*_against_plant(log, proven)]


def made_by_law(problem: LinearMPC, episodes: Sequence[Episode]) -> NDArray[np.bool_]:
    """Return which inputs (m,) are the MPC's own in enough rows: then all units are beyond doubt.

    In these rows the law moves nearly as much as in all of them: in other units what is logged
    would meet it only where it stands still, or on a bound.
    """
    theta = np.concatenate([each.thetas[:-1, : problem.n_theta] for each in episodes])
    u = np.concatenate([each.actions for each in episodes])
    law = law_of(problem)(theta)
    found = np.zeros(u.shape[1], dtype=bool)
    for j, half in enumerate(problem.u_half):
        low = problem.deviations.u_min[j] + LAW * half
        high = problem.deviations.u_max[j] - LAW * half
        inside = (law[:, j] > low) & (law[:, j] < high)
        same = inside & (np.abs(u[:, j] - law[:, j]) <= LAW * half)
        if same.sum() >= max(LEAST_ROWS, PROVING * inside.sum()):
            moves = np.std(law[same, j])
            found[j] = moves > max(10 * LAW * half, 0.5 * np.std(law[inside, j]))
    return found


@dataclass(frozen=True)
class _OnLaw:
    """Each logged input j regressed on each column i of the law, some rows away, at [i, j].

    ``slope`` has the standard ``error``; the regression leaves a share ``left`` of the input's
    variance, and would leave ``left_of_rows`` with theta besides, were all that it adds chance.
    ``offset_room`` is four standard errors of the offset. ``unique`` (m,): the law is more than a
    multiple of one entry of theta.
    """

    slope: Array
    offset: Array
    error: Array
    left: Array
    left_of_rows: Array
    deviation: Array
    offset_room: Array
    unique: NDArray[np.bool_]

    @property
    def alone(self) -> NDArray[np.bool_]:
        """Where the law explains an input, and theta adds nothing to it, (m, m)."""
        made = (self.left < self.left_of_rows + EXACT_SHARE) & (self.left < DITHERED_SHARE)
        return (made & self.unique[:, None]) | (self.left < EXACT_SHARE)


def _rows(log: _Log, shift: int = 0) -> tuple[Array, Array]:
    """Return rows of theta (N, n_theta), ``shift`` away from the inputs (N, m) beside them."""
    layout = log.problem.layout
    thetas = []
    inputs = []
    for each in log.episodes:
        k = np.arange(1, len(each) - 1)
        theta = log.coordinates.row.shown(each.thetas)[k + shift].copy()
        theta[:, layout.previous] = each.actions[k - 1][:, : layout.n_previous]
        thetas.append(theta)
        inputs.append(each.actions[k])
    return np.concatenate(thetas), np.concatenate(inputs)


def _on_law(log: _Log, shift: int, change: tuple[Array, Array] | None = None) -> _OnLaw:
    """Return the regressions on the law at the rows ``shift`` away.

    With ``change`` = (M, v) the law sees M x + v in place of the logged states x.
    """
    m = log.problem.model.n_inputs
    theta, u = _rows(log, shift)
    if change is not None:
        state = log.problem.layout.state
        theta[:, state] = theta[:, state] @ change[0].T + change[1]
    answer = law_of(log.problem)(theta)
    known = np.isfinite(answer).all(axis=1)
    theta = theta[known]
    u = u[known]
    answer = answer[known]
    slope, offset, deviation, room = np.zeros((4, m, m))
    error, left, left_of_rows = np.ones((3, m, m))
    unique = np.zeros(m, dtype=bool)
    own = log.problem.deviations
    for i in range(m):
        inside = np.minimum(answer[:, i] - own.u_min[i], own.u_max[i] - answer[:, i])
        inside = inside > 1e-3 * log.problem.u_half[i]
        y = u[inside]
        a = answer[inside, i]
        x = theta[inside]
        if len(a) < LEAST_ROWS or np.std(a) < 1e-6 * log.problem.u_half[i]:
            continue
        x = x[:, np.std(x, axis=0) > 1e-9 * log.problem.theta_half]
        F = np.column_stack([a - a.mean(), np.ones(len(a))])
        rows = np.column_stack([F, (x - x.mean(axis=0)) / np.std(x, axis=0)])
        spread = np.maximum(np.var(y, axis=0), 1e-12 * log.problem.u_half**2)
        found = np.linalg.lstsq(F, y, rcond=None)[0]
        slope[i] = found[0]
        offset[i] = found[1] - found[0] * a.mean()
        left[i] = np.mean((y - F @ found) ** 2, axis=0) / spread
        rest = y - rows @ np.linalg.lstsq(rows, y, rcond=1e-9)[0]
        # An F test: p columns that say nothing explain p of N rows.
        chance = 1 + 3 * x.shape[1] / len(a)
        left_of_rows[i] = chance * np.mean(rest**2, axis=0) / spread
        error[i] = np.sqrt(left[i] * spread / np.sum(F[:, 0] ** 2))
        # Of one entry of theta every linear controller is the law times a factor.
        share = x - F @ np.linalg.lstsq(F, x, rcond=None)[0]
        unique[i] = np.any(np.var(share, axis=0) > 0.02 * np.var(x, axis=0))
        deviation[i] = np.sqrt(spread)
        room[i] = STANDARD_ERRORS * np.sqrt(left[i] * spread * np.mean(a**2) / np.var(a) / len(a))
    return _OnLaw(slope, offset, error, left, left_of_rows, deviation, room, unique)


def _is_one(on: _OnLaw) -> NDArray[np.bool_]:
    """Return where column i of the law gives input j as it is, [i, j]."""
    near = np.abs(on.slope - 1) < SLOPE_TOLERANCE
    # No plausible factor of units is as near to one as the slope may yet be.
    sure = STANDARD_ERRORS * on.error < 1 - LEAST_GAIN
    return near & sure & (np.abs(on.offset) < SLOPE_TOLERANCE * on.deviation + on.offset_room)


def _against_law(
    log: _Log, readings: dict[int, _OnLaw], proven: NDArray[np.bool_]
) -> Iterator[str]:
    """Yield where an input is the law's of other rows or columns, or in other units."""
    logged = readings[0]
    names = labels_of(log.problem.model)[1]
    for j in np.flatnonzero(~proven):
        own = logged.left[j, j]
        found = [
            (float(on.left[i, j]), s, i)
            for s, on in readings.items()
            for i in range(len(names))
            if on.alone[i, j]
            and ((s == 0 and i == j) or on.left[i, j] < CLEARLY_BETTER * own - 1e-9)
        ]
        if not found:
            continue
        _, s, i = min(found)
        slope = readings[s].slope[i, j]
        cures = ["move the inputs by a row"] if s else []
        cures += ["exchange the columns"] if i != j else []
        cures += ["change the sign"] if slope < 0 else []
        error = STANDARD_ERRORS * readings[s].error[i, j]
        if cures and abs(abs(slope) - 1) < SLOPE_TOLERANCE + error:
            what = f"{'minus ' if slope < 0 else ''}what the MPC gives {names[i]}"
            late = " A controller that acts a sample late is dead time: PastInputs."
            yield (
                f"The logged {names[j]} is {what} in {ROW_NAMES[s]} (it leaves "
                f"{100 * np.sqrt(readings[s].left[i, j]):.3g} % of its deviation; its own leaves "
                f"{100 * np.sqrt(logged.left[j, j]):.3g} %). In the log, "
                f"{' and '.join(cures)}.{late if s == -1 else ''}"
            )


def _against_states(log: _Log, logged: Array, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield where two columns of the states are exchanged, or one has the other sign.

    Then the law gives the inputs from the states so changed, or the given model predicts them.
    """
    row = log.coordinates.row
    n = log.problem.model.n_states
    names = labels_of(log.problem.model)[0]
    x = np.concatenate([each.thetas[:-1] for each in log.episodes])
    u = np.concatenate([each.actions for each in log.episodes])
    after = np.concatenate([each.thetas[1:, row.state] for each in log.episodes])

    def error(change: Array) -> Array:
        rows = np.concatenate([x, u], axis=1)
        rows[:, row.state] = x[:, row.state] @ change.T
        left = after @ change.T - rows @ row.linear[row.state].T
        return np.asarray(np.var(left / np.abs(change @ log.coordinates.units), axis=0)) + 1e-12

    before = error(np.eye(n))
    for i, j in combinations_with_replacement(range(n), 2):
        change = np.eye(n)
        change[[i, j]] = change[[j, i]] if i != j else -change[[i, i]]
        ratio = error(change) / (np.abs(change) @ before)
        fits = ratio.min() < CLEARLY_BETTER and ratio.max() < 1.5
        if not fits and not np.all(proven):
            on = _on_law(log, 0, (change, np.zeros(n)))
            better = np.diagonal(on.left) < CLEARLY_BETTER * logged - 1e-9
            fits = np.any(np.diagonal(_is_one(on) & on.alone) & better & ~proven)
        if fits:
            what = (
                f"{names[i]} and {names[j]} are exchanged" if i != j else f"{names[i]} is negated"
            )
            yield (
                f"The log fits the MPC, or its model, clearly better where {what}: look at the "
                "columns and signs of the states."
            )


def _other_units(log: _Log, logged: _OnLaw, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield which inputs, or which state instead, in another unit or with another zero are the law.

    A law that is nearly linear takes the zero of one state for that of another, or of its input:
    the model tells them apart, or all are named.
    """
    names = labels_of(log.problem.model)
    row = log.coordinates.row
    unit = log.coordinates.units
    n = log.problem.model.n_states
    x = np.concatenate([each.thetas[:-1] for each in log.episodes])
    actions = np.concatenate([each.actions for each in log.episodes])
    after = np.concatenate([each.thetas[1:, row.state] for each in log.episodes])

    def left_by_model(change: Array, shift: Array, u: Array) -> float:
        rows = np.concatenate([x, u], axis=1)
        rows[:, row.state] = x[:, row.state] @ change.T + shift
        error = after @ change.T + shift - rows @ row.linear[row.state].T
        return float(np.mean((error / (change @ unit)) ** 2))

    found: list[tuple[float, str]] = []
    of_inputs = []
    read = actions.copy()
    for j in np.flatnonzero(~proven & np.diagonal(logged.alone)):
        slope = logged.slope[j, j]
        error = STANDARD_ERRORS * logged.error[j, j]
        room = SLOPE_TOLERANCE * logged.deviation[j, j] + logged.offset_room[j, j]
        away = logged.offset[j, j] if abs(logged.offset[j, j]) > room else 0.0
        if abs(slope) > error and (abs(slope - 1) > SLOPE_TOLERANCE + error or away):
            zero = f", {away:+.4g}" if away else ""
            of_inputs.append(
                f"The logged {names[1][j]} is {slope:.4g} times what the MPC gives{zero}"
            )
            read[:, j] = (actions[:, j] - away) / slope
    if of_inputs:
        found = [(left_by_model(np.eye(n), np.zeros(n), read), " and ".join(of_inputs))]
    left_open = ~(proven | _held(log))
    law = law_of(log.problem)
    theta, u = _rows(log)
    some = np.linspace(0, len(u) - 1, min(len(u), 300)).astype(int)  # an online law takes its time
    theta = theta[some]
    u = u[some]
    scale = np.maximum(np.std(u, axis=0), 1e-6 * log.problem.u_half)
    for i in range(n) if left_open.any() else ():

        def left(p: Array, i: int = i) -> Array:
            rows = theta.copy()
            rows[:, i] = p[0] * rows[:, i] + p[1] * unit[i]
            return np.asarray(np.nan_to_num((u - law(rows)) / scale).ravel())

        before = np.mean(left(np.array([1.0, 0.0])) ** 2)
        fit = least_squares(left, [1.0, 0.0], diff_step=1e-4, max_nfev=20)
        factor, zero = fit.x
        moved = abs(np.log(max(abs(factor), 1e-9))) > 2 * SLOPE_TOLERANCE or abs(zero) > 0.2
        if not moved or not np.mean(fit.fun**2) < 0.5 * before:
            continue
        change = np.eye(n)
        shift = np.zeros(n)
        change[i, i] = factor
        shift[i] = zero * unit[i]
        on = _on_law(log, 0, (change, shift))
        if np.any(np.diagonal(_is_one(on) & on.alone) & left_open):
            times = f"{factor:.4g} times " if abs(factor - 1) > 0.01 else ""
            words = f"The MPC gives the logged inputs where {names[0][i]} is {times}what is logged"
            words += f", {shift[i]:+.4g}"
            found.append((left_by_model(change, shift, actions), words))
    least = min((error for error, _ in found), default=0.0)
    if said := [words for error, words in found if CLEARLY_BETTER * error <= least]:
        yield f"{'; or: '.join(said)}: is it in other units, or has it another zero? {CONFIRM}"


def _other_pace(log: _Log) -> Iterator[str]:
    """Yield where the states move as the model's do in several samples: rows are missing.

    The gains are left open, and the zeros: a plant may have others.
    """
    row = log.coordinates.row
    model = log.problem.model
    unit = log.coordinates.units
    z = np.concatenate([row.features(e.thetas[:-1], e.actions) for e in log.episodes])
    after = np.concatenate([e.thetas[1:, row.state] for e in log.episodes])
    x = z[:, : model.n_states]
    n = model.n_states
    m = model.n_inputs
    power: Array = np.eye(n)
    driven: Array = np.zeros((n, m))
    left = []
    for _ in PACES:
        driven = driven + power @ model.B
        power = model.A @ power
        rest = (after - x @ power.T) / unit
        rest -= rest.mean(axis=0)
        u = (z[:, -m:] - z[:, -m:].mean(axis=0))[:, None] * (driven / unit[:, None])
        gains = np.linalg.lstsq(u.reshape(-1, m), rest.ravel(), rcond=1e-9)[0]
        left.append(np.var(rest - u @ gains, axis=0) + ROUNDING)
    ratio = np.array(left) / left[0]
    best = int(np.argmin(ratio.mean(axis=1)))
    if ratio[best].min() < CLEARLY_BETTER and ratio[best].max() < 1.5:
        yield (
            f"From row to row the states move as the model's do in {PACES[best]} samples: are "
            f"rows missing, or is dt = {model.dt:g} another plant's? {CONFIRM}"
        )


def _held(log: _Log) -> NDArray[np.bool_]:
    """Return which inputs (m,) mostly stand still inside of their bounds while the states move.

    No law of the states makes them.
    """
    problem = log.problem.deviations
    units = log.coordinates.units
    state = log.coordinates.row.state
    held = []
    moves = []
    for each in log.episodes:
        u = each.actions
        x = each.thetas[:-1, state]
        still = np.abs(np.diff(u, axis=0)) <= ROUNDING * problem.u_half
        held.append(still & (u[1:] > problem.u_min) & (u[1:] < problem.u_max))
        moves.append(np.any(np.abs(np.diff(x, axis=0)) > MOVING * units, axis=1))
    moving = np.concatenate(moves)
    return np.asarray(np.concatenate(held)[moving].mean(axis=0) > 0.5) & bool(moving.any())


def _against_plant(log: _Log, proven: NDArray[np.bool_]) -> Iterator[str]:
    """Yield where inputs that the law does not prove act otherwise than the model says."""
    fit = _Effects.of(log, 0)
    B = log.problem.model.B
    unit = log.coordinates.units
    if fit is None:
        return
    sizes = np.maximum(np.sum((B / unit[:, None]) ** 2, axis=0), 1e-300)
    weights = (B / unit[:, None] ** 2 / sizes).T  # they make 1 of a column of B
    for s in (-1, 1):
        other = _Effects.of(log, s)
        if other is None:
            continue
        # Inputs that follow the state of their own row tell it, with the other sign: no cause.
        caused = other.follows.min() > 0.7 or np.min(np.sum(weights * other.B.T, axis=1)) > 1 / 3
        ratio = other.left / fit.left
        if (s == -1 or caused) and ratio.min() < 0.5 and ratio.max() < 1.5:
            yield (
                f"The next states follow the inputs of {ROW_NAMES[s]} (they leave "
                f"{100 * ratio.min():.3g} % of what the inputs of the same row leave). Move the "
                "inputs by a row; if the plant acts so late, give the model its dead time."
            )
            return
    yield from _against_gains(log, fit, weights, proven)
    driven = fit.follows.min() > 0.7 and not np.any(proven)  # in closed loop noise moves the zero
    if driven and not (log.problem.layout.has_constants or log.units_confirmed):
        yield from _resting(log, fit)


def _against_gains(
    log: _Log, fit: _Effects, weights: Array, proven: NDArray[np.bool_]
) -> Iterator[str]:
    """Yield where inputs act as others of B do, against its signs, or far otherwise."""
    names = labels_of(log.problem.model)[1]
    own = np.arange(len(weights))
    B = log.problem.model.B
    unit = log.coordinates.units[:, None]
    norms = np.outer(np.linalg.norm(fit.B / unit, axis=0), np.linalg.norm(B / unit, axis=0))
    apart = 1 - ((fit.B / unit).T @ (B / unit) / np.maximum(norms, 1e-300)) ** 2
    columns = linear_sum_assignment(apart)[1]
    sizes = np.linalg.norm(fit.B / np.sqrt(np.diag(fit.covariance))[:, None], axis=0)
    known = np.all(sizes > STANDARD_ERRORS * np.sqrt(len(B)) * fit.factors)
    if known and apart[own, columns].sum() < CLEARLY_BETTER * apart[own, own].sum():
        for j in np.flatnonzero((columns != own) & ~proven):
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
        far = not LEAST_GAIN < gain < 1 / LEAST_GAIN and abs(gain - 1) > error
        # Units make runs of the model better; where they do not, the gain is curvature.
        far = far and _error_of_runs(log, j, gain) < MUCH_BETTER * _error_of_runs(log, j, 1.0)
        if gain + error < 0 and gain < -0.1:
            yield (
                f"The logged {names[j]} moves the plant against the sign of the model's B "
                f"({measured} its effect). Compare its sign and rows."
            )
        elif far and not log.units_confirmed:
            yield (
                f"The logged {names[j]} moves the plant {measured} as much as the model says: "
                f"is it in other units, or a row off? {CONFIRM}"
            )


def _error_of_runs(log: _Log, j: int, gain: float) -> float:
    """Return how far runs of the given model vary from the log, with input j times a gain."""
    row = log.coordinates.row
    errors = []
    linear = row.linear.copy()
    linear[:, row.size + j] *= gain
    for each in log.episodes:
        starts = np.arange(0, max(len(each) - RUN, 1), RUN)
        steps = min(RUN, len(each))
        rows = each.thetas[starts].copy()
        for k in range(steps):
            rows[:, row.given] = each.thetas[starts + k][:, row.given]
            rows = np.hstack([rows, each.actions[starts + k]]) @ linear.T
            row.clip(rows)
        errors.append((rows - each.thetas[starts + steps])[:, row.state] / log.coordinates.units)
    return float(np.var(np.concatenate(errors), axis=0).sum())


def _resting(log: _Log, fit: _Effects) -> Iterator[str]:
    """Yield where the plant moves at x = 0 and u = 0, and so rests elsewhere."""
    if not np.any(np.abs(fit.drift) > STANDARD_ERRORS * fit.drift_error):
        return
    A = log.problem.model.A
    names = labels_of(log.problem.model)[0]
    rest = np.linalg.lstsq(np.eye(len(A)) - A, fit.drift, rcond=1e-3)[0]
    x_ss = log.problem.model.x_ss
    shown = log.problem.units.to_plant(rest)
    away = np.abs(rest / log.coordinates.units)
    if np.max(away) > 5:  # beyond the log: a state that hardly returns, or noise
        return
    for i in np.flatnonzero(away > 0.5):
        yield (
            f"With inputs at u_ss the logged plant rests at {names[i]} = {shown[i]:.4g}, the "
            f"problem's at {x_ss[i]:.4g}: compare units and operating point of states and inputs. "
            f"{CONFIRM}"
        )


@dataclass(frozen=True)
class _Effects:
    """A regression of the next states on states and inputs.

    It finds B (n, m), leaves the ``covariance`` (n, n) and the mean squares ``left`` (n,).
    ``factors`` (m,) are standard errors of a column of B over the deviation of what is left.
    ``drift`` (n,) is the next state of x = 0 and u = 0. ``follows`` (m,) is the deviation of the
    inputs that the states leave, relative to their own.
    """

    B: Array
    covariance: Array
    factors: Array
    left: Array
    drift: Array
    drift_error: Array
    follows: Array

    @classmethod
    def of(cls, log: _Log, shift: int) -> _Effects | None:
        """Return the regression on the inputs some rows away; None where there are few rows.

        Squares of the states count where rows are enough.
        """
        row = log.coordinates.row
        m = log.problem.model.n_inputs
        steps = [(e, np.arange(1, len(e) - 1)) for e in log.episodes]
        z = np.concatenate([row.features(e.thetas[k], e.actions[k + shift]) for e, k in steps])
        z = z / log.coordinates.scale
        y = np.concatenate([e.thetas[k + 1, row.state] for e, k in steps])
        x = z[:, :-m]
        u = z[:, -m:]
        first, second = np.triu_indices(x.shape[1])
        curved = np.hstack([x, x[:, first] * x[:, second]])
        states = curved if len(z) > 5 * (curved.shape[1] + m + 1) else x
        F = np.column_stack([u, np.ones(len(z)), states])
        if len(z) <= 5 * F.shape[1]:
            return None
        scale = np.std(F, axis=0)
        scale[scale < 1e-12] = 1.0
        left, singular, right = np.linalg.svd(F / scale, full_matrices=False)
        kept = singular > 1e-7 * singular[0]
        inverse = np.where(kept, 1 / np.maximum(singular, 1e-300), 1e7 / singular[0])
        slopes = (right.T * inverse * kept) @ (left.T @ y) / scale[:, None]
        rest = y - F @ slopes
        rounding = np.diag((1e-5 * log.coordinates.units) ** 2)
        covariance = rest.T @ rest / (len(z) - F.shape[1]) + rounding
        factors = np.linalg.norm(right.T * inverse, axis=1) / scale
        own = u - F[:, m:] @ np.linalg.lstsq(F[:, m:], u, rcond=None)[0]
        follows = np.std(own, axis=0) / np.maximum(np.std(u, axis=0), 1e-12)
        squares = np.diag(covariance).copy()
        size = log.coordinates.scale[-m:]
        return cls(
            slopes[:m].T / size, covariance, factors[:m] / size, squares, slopes[m],
            np.sqrt(squares) * factors[m], follows,
        )  # fmt: skip
