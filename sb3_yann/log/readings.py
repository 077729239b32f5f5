"""What in a log is no reading, and what may be wrong with a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, warn
from sb3_yann.log.episodes import Episode

NO_READING = -999, -9999, -99999, 999, 9999, 99999  # in place of one, as historians write it
UNITS = (
    *((factor, 0.0) for factor in (1000.0, 100.0, 60.0, 10.0, 0.1, 1 / 60, 0.01, 0.001)),
    *((1.0, shift) for shift in (-273.15, 273.15)),
    *((1.8, 32.0), (1 / 1.8, -32 / 1.8)),
)
"""Units that are mistaken for each other: factors, and what is added."""
LEAST_READ = 10  # readings on either side of it
LONGEST_SPIKE = 3  # readings, unless all are one value


def cleaned(records: list[Episode], names: dict[str, Any]) -> tuple[list[Episode], list[str]]:
    """Return records without what is no reading, and the names of columns that have none.

    What may be wrong besides is warned of.
    """
    empty = []
    periods: dict[str, int] = {}
    driven = set[int]()
    acted = np.concatenate([np.vstack([each.driven[:1], each.driven]) for each in records])
    for of, letter in ("state", "x"), ("input", "u"), ("disturbance", "d"), ("reference", "r"):
        parts = [getattr(each, f"{of}s").copy() for each in records]
        own = names.get(f"{of}_names") or [f"{letter}[{i}]" for i in range(parts[0].shape[1])]
        for i, name in enumerate(own):
            columns = [each[:, i] for each in parts]
            _leave_out_marks(name, columns)
            if of == "state":
                _leave_out_spikes(name, columns, np.nan_to_num(acted))
                periods[name] = _period(columns)
            else:
                driven.add(_period(columns))
            whole = np.concatenate(columns)
            if not np.isfinite(whole).any():
                empty.append(name)
            if of != "reference":
                _warn_of_another_unit(name, whole, of == "state")
        records = [
            replace(each, **{f"{of}s": part}) for each, part in zip(records, parts, strict=True)
        ]
    for name, every in periods.items():
        if every > 1 and every not in driven:
            warn(
                f"{name} changes only once in {every} rows. If a historian repeats a reading, as a "
                "laboratory's, leave the repeats empty (NaN): models and estimators then know it."
            )
    return records, empty


def _leave_out(columns: Sequence[Array], rows: NDArray[np.bool_]) -> None:
    """Set rows of a column, in parts, to NaN."""
    ends = np.cumsum([len(each) for each in columns])[:-1]
    for column, at in zip(columns, np.split(rows, ends), strict=True):
        column[at] = np.nan


def _leave_out_marks(name: str, columns: Sequence[Array]) -> None:
    """Leave out what historians write for no reading, far from all else."""
    column = np.concatenate(columns)
    marks = np.isin(np.trunc(column), NO_READING)
    rest = column[~marks & np.isfinite(column)]
    if not (marks.any() and len(rest)):
        return
    least = np.maximum(10 * np.ptp(rest), np.abs(column) / 2)
    far = marks & (np.abs(column - np.median(rest)) > least)
    far &= (column < 0) | (np.ptp(rest) > 0)  # else a switch may have these two values
    if far.any():
        warn(
            f"{name} of the log is {column[far][0]:g} in {np.count_nonzero(far)} rows, far "
            "from all others: taken for no reading. Leave such cells empty, or NaN."
        )
        _leave_out(columns, far)


def _leave_out_spikes(name: str, columns: Sequence[Array], acted: Array) -> None:
    """Leave out readings that are far beyond the rest: a few, or one value that comes again.

    They stay where there are many, or where an input or load, of which ``acted`` has those that led
    to each row, is then at an end of its range: a plant may answer a pulse so.
    """
    moves = np.abs(np.concatenate([np.diff(each[np.isfinite(each)]) for each in columns]))
    moves = moves[moves > 0]
    if len(moves) < LEAST_READ:
        return
    typical = float(np.quantile(moves, 0.9))
    whole = np.concatenate(columns)
    # 50.0: times nearly all other steps of a state are the two to and from a spike
    far = np.concatenate([_there_and_back(each, 50.0 * typical) for each in columns])
    rest = whole[~far & np.isfinite(whole)]
    far &= np.abs(whole - np.median(rest)) > 1.5 * np.ptp(rest)
    if np.count_nonzero(far) > LONGEST_SPIKE + len(whole) // 1000:
        far[:] = False
    # 10.0: times nearly all other steps are those to and from what a dead transmitter sends
    away = np.concatenate([_there_and_back(each, 10.0 * typical) for each in columns])
    values, counts = np.unique(whole[~far], return_counts=True)
    again = (LONGEST_SPIKE < counts) & (counts <= len(whole) // 20)
    for value in np.intersect1d(values[again], whole[away]):
        down = whole == value
        others = ~down & ~far & np.isfinite(whole)
        beyond = value < whole[others].min() or value > whole[others].max()
        low, high = np.quantile(acted[others], [0.05, 0.95], axis=0)
        then = np.median(acted[down], axis=0)
        if beyond and np.all((low <= then) & (then <= high)):
            far |= down
    rows = np.flatnonzero(far)
    if len(rows):
        warn(
            f"{name} of the log is {whole[rows[0]]:g} in row {rows[0]}, and far from it before "
            f"and after ({len(rows)} such rows): taken for no reading."
        )
        _leave_out(columns, far)


def _there_and_back(column: Array, least: float) -> NDArray[np.bool_]:
    """Return where a record jumps by ``least`` there and back, for a few rows or to one value."""
    rows = np.flatnonzero(np.isfinite(column))
    z = column[rows]
    steps = np.abs(np.diff(z))
    jumps = np.flatnonzero(steps > least)
    found = np.zeros(len(column), bool)
    for i, first in enumerate(jumps):
        for last in jumps[i + 1 : i + 1 + LONGEST_SPIKE]:
            away = slice(first + 1, last + 1)
            few = last - first <= LONGEST_SPIKE
            back = min(steps[first], steps[last]) / (10 if few else 3)  # the plant goes on
            if abs(z[last + 1] - z[first]) < back and (few or np.ptp(z[away]) == 0):
                found[rows[away]] = True
    return found


def _warn_of_another_unit(name: str, column: Array, is_state: bool) -> None:
    """Warn where a column goes on in another unit: where it jumps so far, and its steps grow so."""
    rows = np.flatnonzero(np.isfinite(column))
    z = column[rows]
    steps = np.diff(z)
    k = int(np.argmax(np.abs(steps))) if len(steps) else 0
    if not LEAST_READ <= k < len(steps) - LEAST_READ:
        return
    before, after = (np.sqrt(np.mean(each**2)) for each in (steps[:k], steps[k + 1 :]))
    # 5.0: times any other step of a column that a change of its unit is, at least
    alone = abs(steps[k]) > 5.0 * np.max(np.abs(np.delete(steps, k)))
    for factor, shift in UNITS if alone and before * after > 0 else ():
        near = abs(z[k + 1] - factor * z[k] - shift) < 4 * max(factor * before, after)
        # An input may well be stepped by as much as zeros of units differ.
        if near and 0.5 < factor * before / after < 2 and (is_state or not shift):
            reads = f"{factor:.3g} times " * (factor != 1) + "what it did"
            reads += f" {shift:+g}" * bool(shift)
            warn(
                f"From row {rows[k + 1]} of the log on, {name} reads {reads}: has its unit "
                "changed? Bring the whole column to one unit."
            )


def _period(parts: Sequence[Array]) -> int:
    """Return in how many rows the parts of a column change once; 1 where that is not regular.

    A counter's and a switch's changes are all of one size, or of two: they are no readings.
    """
    count = 0
    apart: list[int] = []
    sizes: list[float] = []
    for z in parts:
        rows = np.flatnonzero(np.isfinite(z))
        steps = np.diff(z[rows])
        count += len(steps)
        apart += [*np.diff(rows[1:][steps != 0])]
        sizes += [*np.abs(steps[steps != 0])]
    if len(apart) < LEAST_READ or 2 * len(sizes) >= count:  # it changes in most rows
        return 1
    if len(np.unique(np.round(sizes / np.max(sizes), 6))) < 3:
        return 1
    found, counts = np.unique(apart, return_counts=True)
    every = int(found[np.argmax(counts)])  # some readings are equal, and change nothing
    # 0.9: share of a column's changes that are as many rows apart, where it repeats readings
    return every if np.mean(np.array(apart) % every == 0) > 0.9 else 1
