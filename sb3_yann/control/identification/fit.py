"""The linear system that fits a plant's log, by least squares; sensors that stand still in one."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_choice, check_range, check_vector
from sb3_yann.control.identification.dead_time import (
    as_delays,
    exact_memory,
    found_delays,
    input_notes,
    memory_labels,
    with_memory,
    with_memory_point,
)
from sb3_yann.control.identification.least_squares import (
    FAR,
    Regression,
    operating_point,
    regress,
    regularized,
)
from sb3_yann.control.identification.residuals import AHEAD, listed, quality_notes
from sb3_yann.control.linear_system import LinearSystem, names
from sb3_yann.log import Episode, Log, split_episodes


@dataclass(frozen=True, eq=False)
class LogFit:
    """A system fitted to a log, its fits one and ten steps ahead, (n,) each, and the dead times."""

    system: LinearSystem
    regression: Regression
    fits: tuple[Array, Array]
    delays: tuple[int, ...]


def fit_log(
    log: Log,
    *,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float | str = "auto",
    held_out: float = 0.2,
    delay: int | str | Sequence[int] = 0,
) -> LogFit:
    """Return the least-squares fit to a log; options as of `identify`."""
    log = log.with_all_states()
    automatic = isinstance(ridge, str) and check_choice("ridge", ridge, ("auto",)) == "auto"
    episodes, sizes = list(log.episodes), log.sizes
    measured = sizes[2] > 0
    require_moving(episodes, sizes)
    episodes, sizes, delays = _delayed(episodes, sizes, delay)
    x_ss = with_memory_point(x_ss, u_ss, delays)
    n, m, d = sizes
    if d_ss is not None and not measured:
        raise ValueError("d_ss is given, but there are no disturbances: pass these as well.")
    point = {"x_ss": (x_ss, n), "u_ss": (u_ss, m), "d_ss": (d_ss, d)}
    given = [
        None if value is None and offset else check_vector(name, value, size)
        for name, (value, size) in point.items()
    ]
    fitted, tested = split_episodes(episodes, check_range("held_out", held_out, 0, 1, "[)"))
    weight = 0.0 if automatic else check_range("ridge", ridge, 0, np.inf)
    origin = None if offset else np.concatenate([part for part in given if part is not None])
    found, shrunk = regress(fitted, sizes, origin, weight), list[str]()
    if automatic:
        found, weight, shrunk = regularized(found, fitted, tested, sizes, origin)
    fits = (_fit(found, tested, 1), _fit(found, tested, AHEAD))
    system = system_of(found, sizes, given, log.dt, delays)
    system = replace(_with_exact_memory(system, delays, sizes[0]), time_unit=log.time_unit)
    late = [] if any(delays) else input_notes(found, episodes, sizes)
    if late:
        warnings.warn(" ".join(late), stacklevel=3)
    quality = quality_notes(found, fitted, tested, fits, 0.0 if shrunk else weight, sum(delays))
    notes = [*system.notes, *_memory_notes(delays, sizes, system.u_ss), *quality, *shrunk, *late]
    if log.lost_steps:
        notes.append(f"{log.lost_steps} steps at gaps, or of another time than dt, are left out.")
    return LogFit(replace(system, notes=tuple(notes)), found, fits, tuple(delays))


def require_moving(episodes: list[Episode], sizes: tuple[int, int, int]) -> None:
    """Raise where a sensor stands still though the plant moves."""
    states = [each.states for each in episodes]
    found = frozen_rows(states, [each.driven for each in episodes])
    if found:
        raise ValueError(" ".join(words_for(found, names(sizes), states)))


def system_of(
    found: Regression,
    sizes: tuple[int, int, int],
    given: Sequence[Array | None],
    dt: float,
    delays: Sequence[int],
) -> LinearSystem:
    """Return the system about its operating point, with notes on drift and extrapolation."""
    n, m, _ = sizes
    point = operating_point(found, sizes, given, delays)
    A, B, E = np.split(found.coefficients, [n, n + m], axis=1)
    x, u, d = np.split(point, [n, n + m])
    notes = []
    drift = found.predict(point[None])[0] - x
    doubt = np.diag(found.covariance) / found.steps
    doubt = np.sqrt(doubt + found.standard_errors**2 @ (point - found.center) ** 2)
    drifts = bool(np.any(np.abs(drift) > 3 * doubt + 1e-9 * (1 + np.abs(x))))
    if drifts:
        words = f"moves by {listed(drift)} in one step. The model leaves that out."
        notes.append(f"At the operating point the fitted plant {words}")
    away = np.flatnonzero(np.abs(x - found.center[:n]) > FAR * found.spread[:n])
    if away.size:
        notes.append(f"x_ss[{away[0]}] lies far outside the data: the model is extrapolated.")
    return LinearSystem(A, B, dt, x, u, E, d, tuple(notes), drift if drifts else None)


def _fit(found: Regression, episodes: list[Episode], steps: int) -> Array:
    """Return each state's fit (n,) in percent, predicted so many steps ahead."""
    errors, targets = [], []
    for episode in episodes:
        starts = max(len(episode) - steps + 1, 0)
        x = episode.states[:starts]
        for k in range(steps):
            x = found.predict(np.hstack([x, episode.driven[k : k + starts]]))
        errors.append(x - episode.states[steps:])
        targets.append(episode.states[steps:])
    target = np.concatenate([*targets, np.zeros((0, found.reached.size))])
    if not len(target):
        return np.full(found.reached.size, np.nan)
    moved = np.linalg.norm(target - np.mean(target, axis=0), axis=0)
    missed = np.linalg.norm(np.concatenate(errors), axis=0)
    return np.asarray(100 * (1 - missed / np.where(moved > 0, moved, np.nan)))


def _delayed(
    episodes: list[Episode], sizes: tuple[int, int, int], delay: int | str | Sequence[int]
) -> tuple[list[Episode], tuple[int, int, int], list[int]]:
    """Return the episodes with past inputs as states, their sizes, and the dead times."""
    n, m, d = sizes
    delays = as_delays(delay, m)
    if delays is None:
        delays = found_delays(episodes, m)
    if not any(delays):
        return episodes, sizes, delays
    extended = with_memory(episodes, delays)
    if not extended:
        raise ValueError(
            f"delay = {delay!r}, but no episode has more than {max(delays)} steps: record longer."
        )
    return extended, (n + sum(delays), m, d), delays


def _with_exact_memory(system: LinearSystem, delays: list[int], n: int) -> LinearSystem:
    """Return the system with the rows of past inputs as they are, rather than as fitted."""
    if not any(delays):
        return system
    A, B = exact_memory(system.A, system.B, delays, n - sum(delays))
    E = system.E.copy()
    E[n - sum(delays) :] = 0.0
    memory = memory_labels(delays, names((0, len(delays))))
    labels = (*names((n - sum(delays),)), *memory)
    return replace(system, A=A, B=B, E=E, state_names=labels)


def _memory_notes(delays: list[int], sizes: tuple[int, int, int], u_ss: Array) -> list[str]:
    """Return a note on the dead time that the model holds."""
    if not any(delays):
        return []
    n = sizes[0] - sum(delays)
    inputs = names((0, sizes[1]))
    labels = ", ".join(memory_labels(delays, inputs))
    return [
        f"Dead time: inputs act for {delays} samples. The states from x[{n}] on are the inputs on "
        f"their way, {labels}. Show them to a policy: sb3_yann.wrappers.PastInputs(env, {delays}, "
        f"initial=[{', '.join(f'{each:.6g}' for each in u_ss)}])."
    ]


SHARE = 0.05
"""Of all rows: so many repeated readings of one sensor are too many."""
LEAST, TIMES = 10, 10.0
"""Equal readings in a row that a frozen sensor shows at least; how many times as many as usual."""


@dataclass(frozen=True)
class Frozen:
    """Equal readings in a row of one state: from the row ``first`` to ``last`` of an episode."""

    episode: int
    state: int
    first: int
    last: int


def frozen_rows(states: Sequence[Array], driven: Sequence[Array]) -> list[Frozen]:
    """Return where states (T+1, n) read exactly the same for long though the plant moves.

    A sensor that counts in steps repeats itself often: runs count from ten times its usual length
    on. A plant at rest repeats itself while nothing else moves. A state that rests by itself is
    found at rest by a linear model of the other rows. A clipped one rests at an end of its range.
    None of these is frozen, and none is returned where they are less than 5 % of all rows.
    ``driven`` (T, k) are the inputs and disturbances between the rows.
    """
    rows, found = sum(map(len, states)), list[Frozen]()
    for i in range(states[0].shape[1]):
        runs = [*_runs([x[:, i] for x in states], i)]
        usual = float(np.median([*map(_length, runs)]))
        long = [each for each in runs if _length(each) >= max(LEAST, TIMES * usual)]
        if long:
            stuck = _Column(states, driven, i, runs, long)
            those = [each for each in long if stuck.is_frozen(each)]
            if sum(map(_length, those)) > SHARE * rows:
                found += those
    return found


def words_for(found: Sequence[Frozen], names: Sequence[str], values: Sequence[Array]) -> list[str]:
    """Return one sentence for each frozen state: which rows, what it reads, what to do."""
    said = []
    for state in dict.fromkeys(each.state for each in found):
        those = [each for each in found if each.state == state]
        longest = max(those, key=_length)
        read = values[longest.episode][longest.first, state]
        more = f", and in {len(those) - 1} more places" if len(those) > 1 else ""
        said.append(
            f"{names[state]} reads exactly {read:.6g} in rows {longest.first} to {longest.last} of "
            f"episode {longest.episode}{more}, while the plant moves: its sensor is frozen. Cut "
            "the episode there, and leave these rows out."
        )
    return said


class _Column:
    """One state of a log, and what its other rows say of its long runs."""

    def __init__(
        self,
        states: Sequence[Array],
        driven: Sequence[Array],
        i: int,
        runs: list[Frozen],
        long: list[Frozen],
    ) -> None:
        self.i, self.states, self.driven, self.runs = i, states, driven, runs
        inside = [np.zeros(len(x), dtype=bool) for x in states]
        for each in long:
            inside[each.episode][each.first : each.last + 1] = True
        self.free = [~(mask[1:] | mask[:-1]) for mask in inside]
        steps = [np.diff(x[:, i])[free] for x, free in zip(states, self.free, strict=True)]
        moved = np.abs(np.concatenate(steps))
        self.typical = float(np.median(moved[moved > 0])) if np.any(moved > 0) else 0.0
        others = [np.delete(x[:-1], i, axis=1) for x in states]
        self.others = [np.hstack(pair) for pair in zip(others, driven, strict=True)]
        self.spread = np.std(np.concatenate(self.others), axis=0)
        column = np.concatenate([x[:, i] for x in states])
        self.ends = column.min(), column.max()
        self.weights = self._fit()

    def is_frozen(self, run: Frozen) -> bool:
        """Return whether nothing but a frozen sensor explains a run."""
        x, stop = self.states[run.episode], min(run.last, len(self.states[run.episode]) - 1)
        moving = np.std(self.others[run.episode][run.first : stop], axis=0)
        if not self.typical or not np.any(moving > SHARE * self.spread):
            return False
        steps = slice(run.first, stop)
        at = np.hstack([x[steps], self.driven[run.episode][steps], np.ones((stop - run.first, 1))])
        predicted = np.sqrt(np.mean((at @ self.weights) ** 2)) / self.typical
        value = x[run.first, self.i]
        comes_back = any(
            each != run and _length(each) > 2 and self._value(each) == value for each in self.runs
        )
        clipped = value in self.ends and (comes_back or run.first > 0)
        if clipped or (comes_back and predicted < 1):
            return False
        alive = all(each > 0.2 * self.typical for each in self._beside(run))
        return bool(predicted > 1e-3 and (predicted > 1 or alive))

    def _value(self, run: Frozen) -> float:
        return float(self.states[run.episode][run.first, self.i])

    def _beside(self, run: Frozen) -> list[float]:
        """Return how far one step moves just before and just after a run, where there is one."""
        moves = np.abs(np.diff(self.states[run.episode][:, self.i]))
        before, after = moves[max(run.first - 5, 0) : run.first], moves[run.last : run.last + 5]
        return [float(np.median(each)) for each in (before, after) if len(each)] or [0.0]

    def _fit(self) -> Array:
        """Return a linear model (n + k + 1,) of how far one step moves the state."""
        columns, targets = [], []
        for x, u, free in zip(self.states, self.driven, self.free, strict=True):
            columns.append(np.hstack([x[:-1], u, np.ones((len(u), 1))])[free])
            targets.append(np.diff(x[:, self.i])[free])
        fit = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
        return np.asarray(fit)


def _runs(columns: Sequence[Array], state: int) -> Iterator[Frozen]:
    """Yield all runs of equal readings, those of one reading as well."""
    for episode, x in enumerate(columns):
        edges = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0) + 1, [len(x)]])
        for first, stop in pairwise(edges):
            yield Frozen(episode, state, int(first), int(stop) - 1)


def _length(run: Frozen) -> int:
    return run.last - run.first + 1
