"""A plant's log: episodes of states, inputs and measured disturbances, checked and cut at gaps."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import LARGEST_BOUND, Array, check_int, check_positive, to_float, warn

Arrays = ArrayLike | Sequence[ArrayLike]
"""One array for each episode, or that of a single one."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode without gaps: states (T + 1, n), inputs (T, m) and disturbances (T, d).

    States are before every input and after the last one, inputs as they were executed, and
    disturbances and references (T, p) of then; without entries where there were none.
    """

    states: Array
    inputs: Array
    disturbances: Array = field(default_factory=lambda: np.zeros((0, 0)))
    references: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __len__(self) -> int:
        """Return the number of steps T."""
        return len(self.inputs)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """The numbers n, m and d of states, inputs and disturbances."""
        return self.states.shape[1], self.inputs.shape[1], self.disturbances.shape[1]

    @property
    def driven(self) -> Array:
        """Inputs and disturbances of each step, shape (T, m + d)."""
        if not self.disturbances.size:
            return self.inputs
        return np.hstack([self.inputs, self.disturbances])

    @property
    def regressors(self) -> Array:
        """State, inputs and disturbances of each step, shape (T, n + m + d)."""
        return np.hstack([self.states[:-1], self.driven])

    def part(self, start: int, stop: int) -> Episode:
        """Return the steps from start to before stop."""
        given = (each[start:stop] for each in (self.inputs, self.disturbances, self.references))
        return Episode(self.states[start : stop + 1], *given)


def in_names(text: str, **names: Sequence[str]) -> str:
    """Return a text with names in place of ``x[0]``, ``y[0]``, ``u[0]`` and ``d[0]``, by letter."""

    def name(found: re.Match[str]) -> str:
        known = names.get(found[1], ())
        number = int(found[2])
        return known[number] if number < len(known) else found[0]

    return re.sub(r"\b([xyud])\[(\d+)\]", name, text)


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Episodes of one plant, with the names of what was logged.

    Attributes
    ----------
    episodes : tuple of Episode
        At least two steps in all. States that are read now and then are NaN in between.
    dt : float
        Sampling time.
    state_names, input_names, disturbance_names : tuple of str
        Empty where nobody named them.
    lost_steps : int
        Steps left out: beside gaps, or of another time than ``dt``.
    units : tuple of str
        Of states, inputs and disturbances in turn; empty where no header names them.
    time_unit : str
        Of ``dt``.

    Examples
    --------
    >>> log = Log.from_arrays([[0.0], [1.0], [1.5]], [[1.0], [1.0]], dt=0.5)
    >>> log
    Log(1 episode, 2 steps of dt = 0.5; 1 state, 1 input)
    >>> log.episodes[0].states.shape
    (3, 1)
    """

    episodes: tuple[Episode, ...]
    dt: float
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    disturbance_names: tuple[str, ...] = ()
    lost_steps: int = 0
    units: tuple[str, ...] = ()
    time_unit: str = ""

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.episodes)

    def __repr__(self) -> str:
        """Return how much there is of what."""
        names = self.state_names, self.input_names, self.disturbance_names
        columns = [
            f"{size} {what}{'s' * (size > 1)}{' (' * bool(of)}{', '.join(of)}{')' * bool(of)}"
            for size, what, of in zip(
                self.sizes, ("state", "input", "disturbance"), names, strict=True
            )
            if size
        ]
        steps = sum(len(each) for each in self.episodes)
        dt = f"{self.dt:g} {self.time_unit}".rstrip()
        lost = f"; {self.lost_steps} steps at gaps left out" if self.lost_steps else ""
        return (
            f"Log({len(self)} episode{'s' * (len(self) > 1)}, {steps:,} steps of dt = {dt}; "
            f"{', '.join(columns)}{lost})"
        )

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        """Yield states (T + 1, n) and inputs (T, m) of each episode."""
        for each in self.episodes:
            yield each.states, each.inputs

    @property
    def sizes(self) -> tuple[int, int, int]:
        """The numbers n, m and d of states, inputs and disturbances."""
        return self.episodes[0].sizes

    @property
    def named_units(self) -> dict[str, str]:
        """The unit of each named state, input and disturbance; empty where no header has one."""
        names = (*self.state_names, *self.input_names, *self.disturbance_names)
        return dict(zip(names, self.units, strict=False))

    def in_names(self, text: str) -> str:
        """Return a text with the log's names: see :func:`in_names`."""
        shown = self.state_names
        own = {"u": self.input_names, "d": self.disturbance_names}
        return in_names(text, x=shown, y=shown, **own)

    @property
    def every(self) -> tuple[int, ...]:
        """Each state is read every so many samples, on average; 1 where none is missing."""
        read = [np.isfinite(each.states) for each in self.episodes]
        whole = np.concatenate(read)
        periods = np.ones(self.sizes[0], int)
        for i in np.flatnonzero(~whole.all(axis=0)):
            # From one reading to the next: gaps and ends of episodes leave out parts of periods.
            apart = np.concatenate([np.diff(np.flatnonzero(each[:, i])) for each in read])
            mean = apart.mean() if apart.size else len(whole) / max(whole[:, i].sum(), 1)
            periods[i] = max(2, round(mean))
        return tuple(periods.tolist())

    def cut(self, steps: int) -> Log:
        """Return the log in pieces of at most so many steps: a long record as many episodes."""
        check_int("steps", steps, 2)
        parts = [
            each.part(first, min(first + steps, len(each)))
            for each in self.episodes
            for first in range(0, len(each), steps)
        ]
        return replace(self, episodes=tuple(parts))

    def with_all_states(self) -> Log:
        """Return the log cut where a state is not read.

        ValueError names the states read now and then, if no two samples in a row have all.
        """
        if max(self.every) == 1:
            return self
        episodes = _cut(self.episodes, np.zeros(len(self.every), bool))
        if sum(map(len, episodes)) < 2:
            names = self.state_names or [f"x[{i}]" for i in range(len(self.every))]
            rare = [f"{a} every {k}" for a, k in zip(names, self.every, strict=True) if k > 1]
            raise ValueError(
                f"Read now and then: {', '.join(rare)} samples. A model of states needs all of "
                "them at each sample. Pass the log to identify_outputs, and an estimator to what "
                "needs states (PlantTwin.fit(mpc, log, observer=...)), or leave them out of states."
            )
        lost = sum(map(len, self.episodes)) - sum(map(len, episodes))
        return replace(self, episodes=tuple(episodes), lost_steps=self.lost_steps + lost)

    @classmethod
    def from_arrays(
        cls,
        states: Arrays,
        inputs: Arrays,
        dt: float,
        *,
        disturbances: Arrays | None = None,
        time: Arrays | None = None,
        time_unit: str = "",
    ) -> Log:
        """Return the log of arrays, one for each episode, or of a single one.

        Parameters
        ----------
        states : array_like, shape (T + 1, n), or a sequence of such
            Before every input, and after the last one. What stands for no reading, such as -9999
            far from all others, is a gap.
        inputs, disturbances : array_like, shapes (T, m) and (T, d), or sequences of such
            The inputs as they were executed, and what was measured with them.
        dt : float
            Sampling time.
        time : array_like, shape (T + 1,), or a sequence of such, optional
            When each row of the states was measured. Steps that differ from ``dt`` by more than
            10 % are left out, and the episode is cut there; 30 % where stamps jitter about a grid.
        time_unit : str, optional
            Of ``dt`` and ``time``, for reports and plots.

        Raises
        ------
        ValueError
            For shapes that do not fit, or numbers that are not finite.
        """
        records = _records({"states": states, "actions": inputs, "disturbances": disturbances})
        if sum(map(len, records)) < 2:
            first = records[0]
            raise ValueError(
                f"states has shape {first.states.shape} and actions {first.inputs.shape}: one step "
                "says nothing. Rows are samples and columns states or inputs; transpose a log "
                "that has them otherwise."
            )
        return cls._of(records, dt, time, time_unit=time_unit)

    @classmethod
    def with_gaps(
        cls, outputs: Arrays, inputs: Arrays, dt: float, disturbances: Arrays | None = None
    ) -> Log:
        """Return the log of arrays, cut where an entry is NaN that is read in most samples.

        Parameters
        ----------
        outputs, inputs, dt, disturbances
            As of :meth:`from_arrays`, NaN where nothing was read.
        """
        given = {"outputs": outputs, "inputs": inputs, "disturbances": disturbances}
        return cls._of(_records(given, gaps=True), dt)

    @classmethod
    def _of(
        cls, records: list[Episode], dt: float, time: Arrays | None = None, **names: Any
    ) -> Log:
        """Return the log of records, cut at gaps and where a step takes another time."""
        dt = check_positive("dt", dt)
        records, empty = _cleaned(records, names)
        on_time = None if time is None else _on_time(records, time, dt)
        episodes = _cut(records, _read_now_and_then(records), on_time)
        kept = sum(map(len, episodes))
        if not kept:
            which = f"; never read: {', '.join(empty)}" if empty else ""
            raise ValueError(
                f"The log has no two samples in a row with all that is to be read{which}."
            )
        return cls(tuple(episodes), dt, lost_steps=sum(map(len, records)) - kept, **names)

    @classmethod
    def from_csv(  # noqa: PLR0913 (what a file is like, by name)
        cls,
        path: str | os.PathLike[str],
        states: Sequence[str],
        inputs: Sequence[str],
        dt: float,
        *,
        disturbances: Sequence[str] = (),
        references: Sequence[str] = (),
        episode: str | None = None,
        time: str | None = None,
        delimiter: str = ",",
        time_unit: str = "",
        decimal: str = ".",
        encoding: str = "utf-8-sig",
    ) -> Log:
        """Return the log of a CSV file with a header, as a historian writes it.

        A row holds the state at a sample and the inputs that act from there on. An episode ends
        before the row in which ``episode`` changes, or where ``time`` jumps or a reading is
        missing; it needs no mark in the file. Its last row is the state that the last inputs led
        to: the inputs of that row do not count. Without ``episode`` and ``time`` all rows are one
        episode, and a warning names the columns that may tell.

        Parameters
        ----------
        path : path-like
            The file.
        states, inputs, disturbances, references : sequence of str
            Names of columns. Of a header ``T [K]`` the name is ``T``, and the unit ``K``.
            References are the MPC's set-points, for its twin.
        dt : float
            Sampling time.
        episode : str, optional
            A column that changes from one episode to the next, such as a batch's number.
        time : str, optional
            A column of times in the unit of its header, else in that of ``dt``; or of ISO 8601 time
            stamps: then ``dt`` is in seconds, or in the ``time_unit`` "min", "h" or "d". An episode
            ends where a step takes another time.
        delimiter : str, default ","
            Between two columns.
        time_unit : str, optional
            Of ``dt``; by default that of the column of times.
        decimal, encoding : str
            The decimal sign, a point by default, and the file's encoding, UTF-8.

        Raises
        ------
        ValueError
            For a column that is not there or there twice, a row that holds no number where it
            should, or one that is longer than the header. An episode ends where a reading is
            missing, or words such as "Bad Input" are in its place, but for states that are read now
            and then, as a laboratory's: these stay NaN.
        """
        more = {"disturbances": disturbances, "references": references}
        for name, given in {"states": states, "inputs": inputs, **more}.items():
            if isinstance(given, str) or not (name in more or given):
                raise ValueError(f"{name} = {given!r} must be a list of column names.")
        try:
            text = Path(path).read_text(encoding)
        except UnicodeError:
            raise ValueError(
                f"{path} is not in {encoding}: pass encoding='latin-1', 'utf-16' or what it is in."
            ) from None
        header, content, lines = _rows(path, text, delimiter)
        columns = {
            name: _column(path, name, header)
            for name in (*states, *inputs, *disturbances, *references, episode, time)
            if name is not None
        }
        wanted = [columns[name] for name in (*states, *inputs, *disturbances, *references)]
        if twice := [name for name in wanted if wanted.count(name) > 1]:
            raise ValueError(
                f"Column {twice[0]!r} is named twice. Each state, input and disturbance has a "
                "column of its own."
            )
        table = np.array(
            [
                [_number(path, line, row, name, decimal) for name in wanted]
                for line, row in zip(lines, content, strict=True)
            ]
        )
        if not len(table):
            raise ValueError(f"{path} has no rows below its header.")
        _warn_of_words(path, content, wanted, table)
        unread = [each for each in header if each not in wanted]
        if unread and episode is None and time is None:
            warn(
                f"All {len(table):,} rows of {path} are read as one record, cut only where a "
                f"reading is missing. If one of its other columns, {unread}, tells where an "
                "episode ends, pass time= or episode=."
            )
        n = len(states)
        m = len(inputs)
        d = len(disturbances)
        x, *others = np.split(table, [n, n + m, n + m + d], axis=1)
        labels = [row[columns[episode]] if episode else "" for row in content]
        starts = [k for k in range(len(table)) if k == 0 or labels[k] != labels[k - 1]]
        edges = pairwise([*starts, len(table)])
        parts = [slice(first, stop) for first, stop in edges if stop - first > 1]
        records = [Episode(x[part], *(each[part][:-1] for each in others)) for part in parts]
        if not records:
            raise ValueError(f"{path} holds no two rows of an episode.")
        times = None
        own = _name_and_unit(columns[time])[1] if time else ""
        if time is not None:
            unit = time_unit or own
            pairs = [
                _time(path, line, row, columns[time], unit, decimal)
                for line, row in zip(lines, content, strict=True)
            ]
            instants, stamped = np.array(pairs).T
            if np.any(stamped):
                time_unit = unit or "s"
            elif own in SECONDS and unit in SECONDS:
                instants = instants * SECONDS[own] / SECONDS[unit]
            elif own not in ("", unit):
                raise ValueError(
                    f"{path} has times in {own!r} by its header, and time_unit = {unit!r}: "
                    f"expected are {[*SECONDS]}, in both."
                )
            times = [instants[part] for part in parts]
        names, units = zip(*map(_name_and_unit, wanted[: n + m + d]), strict=True)
        return cls._of(
            records,
            dt,
            times,
            state_names=names[:n],
            input_names=names[n : n + m],
            disturbance_names=names[n + m :],
            units=units if any(units) else (),
            time_unit=time_unit or own,
        )


SECONDS = {"s": 1, "min": 60, "h": 3600, "d": 86400}  # in a unit of time


NO_READING = -999, -9999, -99999, 999, 9999, 99999  # in place of one, as historians write it
OFTEN_READ = 2 / 3
"""Share of the samples below which isolated readings make a state one that is read now and then."""
SHORT_RUN = 4  # readings, on average between two gaps, from which on a state is cut at each of them
FEWEST_RUNS = 10  # so many that an average says something


def _read_now_and_then(records: Sequence[Episode]) -> NDArray[np.bool_]:
    """Return which states (n,) have isolated readings, as a laboratory's, or many short gaps."""
    read = np.isfinite(np.concatenate([each.states for each in records]))
    # A reading whose sample before has none begins a run; records count as one.
    runs = np.sum(read[1:] > read[:-1], axis=0) + read[0]
    count = np.sum(read, axis=0)
    isolated = (count < OFTEN_READ * len(read)) & (runs > count / 2)
    return np.asarray(
        (0 < count) & (isolated | ((runs >= FEWEST_RUNS) & (runs > count / SHORT_RUN)))
    )


def _cut(
    records: Sequence[Episode],
    rare: NDArray[np.bool_],
    on_time: Sequence[NDArray[np.bool_]] | None = None,
) -> list[Episode]:
    """Return runs of steps in which nothing is missing but rare states, and all are on time."""
    found = []
    for i, each in enumerate(records):
        there: NDArray[np.bool_] = np.all(np.isfinite(each.states[:, ~rare]), axis=1)
        complete = np.isfinite(each.driven).all(axis=1)
        if each.references.size:
            complete &= np.isfinite(each.references).all(axis=1)
        late = [] if on_time is None else [on_time[i]]
        whole = np.all([there[:-1], there[1:], complete, *late], axis=0)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], whole, [0]])))
        found += [each.part(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return found


def _records(given: dict[str, Arrays | None], *, gaps: bool = False) -> list[Episode]:
    """Return records of states, inputs and disturbances by name, with NaN where allowed."""
    parts = {
        name: as_matrices(name, values, gaps=gaps)
        for name, values in given.items()
        if values is not None
    }
    x, *driven = parts.values()
    for name in [*parts][1:]:
        require_one_state_more(name, parts[name], x)
    if len(driven) < 2:
        driven.append([np.zeros((len(each), 0)) for each in driven[0]])
    return [Episode(*each) for each in zip(x, *driven, strict=True)]


def split_episodes(
    episodes: Sequence[Episode], held_out: float
) -> tuple[list[Episode], list[Episode]]:
    """Return what to fit and what to test: the last of all steps, cutting an episode if need be."""
    total = sum(map(len, episodes))
    left = total - max(1, round(held_out * total)) if held_out else total
    fitted: list[Episode] = []
    tested: list[Episode] = []
    for episode in episodes:
        border = min(left, len(episode))
        left -= border
        fitted += [episode.part(0, border)] if border else []
        tested += [episode.part(border, len(episode))] if border < len(episode) else []
    return fitted, tested


def _column(path: object, name: str, header: Sequence[str]) -> str:
    """Return the column of this name, with or without its unit."""
    found = [each for each in header if name in (each, _name_and_unit(each)[0])]
    if not found:
        marks = ";,\t" if len(header) == 1 else ";"
        other = next((each for each in marks if each in "".join(header)), "")
        hint = f" Its delimiter seems to be another: pass delimiter={other!r}." * bool(other)
        hint += " It is empty." * (not header)
        raise ValueError(f"{path} has no column {name!r}; it has {list(header)}.{hint}")
    if len(found) > 1:
        raise ValueError(f"{path} has several columns {name!r}: give each its own name.")
    return found[0]


def _name_and_unit(header: str) -> tuple[str, str]:
    """Return the name and the unit of a column: ``T [K]`` is T in K."""
    name, bracket, unit = header.strip().removesuffix("]").rpartition(" [")
    return (name.strip(), unit.strip()) if bracket and header.endswith("]") else (header, "")


def _cleaned(records: list[Episode], names: dict[str, Any]) -> tuple[list[Episode], list[str]]:
    """Return records without what is no reading, and the names of columns that have none.

    What may be wrong besides is warned of.
    """
    empty = []
    periods: dict[str, int] = {}
    driven = set[int]()
    for of, letter in ("state", "x"), ("input", "u"), ("disturbance", "d"), ("reference", "r"):
        parts = [getattr(each, f"{of}s").copy() for each in records]
        own = names.get(f"{of}_names") or [f"{letter}[{i}]" for i in range(parts[0].shape[1])]
        for i, name in enumerate(own):
            columns = [each[:, i] for each in parts]
            _leave_out_marks(name, columns)
            if of == "state":
                _leave_out_spikes(name, columns)
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


UNITS = (
    *((factor, 0.0) for factor in (1000.0, 100.0, 60.0, 10.0, 0.1, 1 / 60, 0.01, 0.001)),
    *((1.0, shift) for shift in (-273.15, 273.15)),
    *((1.8, 32.0), (1 / 1.8, -32 / 1.8)),
)
"""Units that are mistaken for each other: factors, and what is added."""
JUMP = 5.0  # times any other step of a column that a change of its unit is, at least
LEAST_READ = 10  # readings on either side of it
REGULAR = 0.9  # share of a column's changes that are as many rows apart, where it repeats readings


SPIKE = 50.0  # times nearly all other steps of a state are the two to and from a spike
LONGEST_SPIKE = 3  # readings, unless all are one value
DOWN = 10.0  # times nearly all other steps are those to and from what a dead transmitter sends


def _leave_out_spikes(name: str, columns: Sequence[Array]) -> None:
    """Leave out readings that are far beyond the rest: a few, or one value that comes again.

    They stay where there are many: a plant may answer a pulse so.
    """
    moves = np.abs(np.concatenate([np.diff(each[np.isfinite(each)]) for each in columns]))
    moves = moves[moves > 0]
    if len(moves) < LEAST_READ:
        return
    typical = float(np.quantile(moves, 0.9))
    whole = np.concatenate(columns)
    far = np.concatenate([_there_and_back(each, SPIKE * typical) for each in columns])
    rest = whole[~far & np.isfinite(whole)]
    far &= np.abs(whole - np.median(rest)) > 1.5 * np.ptp(rest)
    if np.count_nonzero(far) > LONGEST_SPIKE + len(whole) // 1000:
        far[:] = False
    away = np.concatenate([_there_and_back(each, DOWN * typical) for each in columns])
    for value in np.unique(whole[away & ~far]):
        down = whole == value
        rest = whole[~down & ~far & np.isfinite(whole)]
        if LONGEST_SPIKE < np.count_nonzero(down) <= len(whole) // 20:
            far |= down & ((value < rest.min()) | (value > rest.max()))
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
            stands = np.ptp(z[away]) == 0  # longer, in which the plant goes on
            back = min(steps[first], steps[last]) / (3 if stands else 10)
            if abs(z[last + 1] - z[first]) < back and (stands or last - first <= LONGEST_SPIKE):
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
    alone = abs(steps[k]) > JUMP * np.max(np.abs(np.delete(steps, k)))
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
    return every if np.mean(np.array(apart) % every == 0) > REGULAR else 1


def _number(path: object, line: int, content: dict[str, str], name: str, decimal: str) -> float:
    text = (content[name] or "").strip()
    try:
        if decimal != "." and "." in text:
            raise ValueError
        return float(text.replace(decimal, ".")) if text else np.nan
    except ValueError:
        if _is_word(text):  # see `_warn_of_words`
            return np.nan
        raise ValueError(
            f"{path}, line {line}: {name} is {text!r}, expected a number whose decimal sign is "
            f"{decimal!r}: decimal= says which it is. Leave out thousands' separators, and the "
            "cell empty where there is no reading."
        ) from None


def _rows(
    path: object, text: str, delimiter: str
) -> tuple[list[str], list[dict[str, str]], list[int]]:
    """Return header, rows and their lines in the file: blank ones are skipped."""
    rows = csv.DictReader(StringIO(text), delimiter=delimiter)
    header = list(rows.fieldnames or [])
    content: list[dict[str, str]] = []
    lines: list[int] = []
    for row in rows:
        if rows.restkey in row:
            raise ValueError(
                f"{path}, line {rows.line_num} has more entries than the header, {header}, has "
                "names. Leave out lines above the header. Numbers with a decimal comma need "
                f"another delimiter than {delimiter!r}, and decimal=','."
            )
        content.append(row)
        lines.append(rows.line_num)
    return header, content, lines


def _is_word(text: str) -> bool:
    """Return whether a cell is no number, as "Bad Input", "Bad (0x80)", "#DIV/0!" and "---"."""
    return text[:1].isalpha() or text[:1] == "#" or not any(map(str.isdigit, text))


def _warn_of_words(
    path: object, content: Sequence[dict[str, str]], names: Sequence[str], values: Array
) -> None:
    """Warn of words in place of readings; raise where a column has nothing else."""
    for name, column in zip(names, values.T, strict=True):
        texts = [(row[name] or "").strip() for row in content]
        words = Counter(each for each in texts if _is_word(each))
        for blank in ("", "nan", "NaN"):
            words.pop(blank, None)
        shown = ", ".join(f"{word!r} in {count:,} rows" for word, count in words.most_common(3))
        if words and not np.isfinite(column).any():
            raise ValueError(f"{path}: {name} is {shown}, and never a number.")
        if words:
            warn(f"{name} of {path} is {shown}: taken for no reading.")


def _time(
    path: object, line: int, content: dict[str, str], name: str, unit: str, decimal: str
) -> tuple[float, bool]:
    """Return a time as it is given, an ISO 8601 time stamp in the unit, and which of them it is."""
    with suppress(ValueError):
        number = _number(path, line, content, name, decimal)
        if not any(1.9 < number / size < 2.1 for size in (1e11, 1e13)):  # 20260131080000 is none
            return number, False
    try:
        stamp = datetime.fromisoformat(content[name].strip())
    except ValueError:
        raise ValueError(
            f"{path}, line {line}: {name} is {content[name]!r}, expected a number or a time "
            "stamp such as 2026-01-31 08:00. pandas.to_datetime(column, format=...) makes it."
        ) from None
    if unit not in ("", *SECONDS):
        raise ValueError(
            f"{path} has time stamps, and time_unit = {unit!r}: expected one of {[*SECONDS]}, "
            "that of dt."
        )
    # A stamp with an offset from UTC counts in UTC: local time runs twice where clocks go back.
    epoch = datetime(1970, 1, 1, tzinfo=stamp.tzinfo and timezone.utc)
    passed = (stamp - epoch).total_seconds()
    return passed / SECONDS[unit or "s"], True


def require_one_state_more(name: str, parts: list[Array], states: list[Array]) -> None:
    """Raise unless each episode has one row of states more than of something else."""
    if len(parts) != len(states):
        raise ValueError(f"{name} has {len(parts)} episodes, states has {len(states)}.")
    for i, (part, state) in enumerate(zip(parts, states, strict=True)):
        if len(part) + 1 != len(state) or not len(part):
            raise ValueError(
                f"{name} of episode {i} has {len(part)} rows, states has {len(state)}. "
                "Expected T >= 1 and T + 1: the states before each action and after the last."
            )


def _on_time(records: list[Episode], time: Arrays, dt: float) -> list[NDArray[np.bool_]]:
    """Return which steps of each record take dt."""
    if isinstance(time, (list, tuple)) and len(time) > 0 and np.ndim(time[0]) == 1:
        times = [to_float(f"time of episode {i}", part) for i, part in enumerate(time)]
    else:
        array = to_float("time", time)
        times = list(array) if array.ndim == 2 else [array]
    if len(times) != len(records):
        raise ValueError(f"time has {len(times)} episodes, states has {len(records)}.")
    for i, (record, instants) in enumerate(zip(records, times, strict=True)):
        if instants.shape != (len(record) + 1,):
            wanted = f"({len(record) + 1},): one for each row of states"
            raise ValueError(f"time of episode {i} has shape {instants.shape}, expected {wanted}.")
        back = np.diff(instants) <= 0
        if np.any(back):
            raise ValueError(
                f"time of episode {i} does not increase after row {int(np.argmax(back))}. "
                "Sort the log, and leave out rows that stand there twice; where time begins anew "
                "in each episode, name the column of episodes, episode=."
            )
    found = [_near_grid(each, dt) for each in times]
    whole = np.concatenate([np.diff(each) for each in times])
    uneven = ~np.concatenate(found)
    middle = float(np.nanmedian(whole))
    most = 2 * np.sum(uneven) > len(whole)
    if most and abs(middle - dt) > 0.1 * dt:
        fits = [unit for unit, s in SECONDS.items() if abs(middle - dt * s) <= 0.1 * dt * s]
        raise ValueError(
            f"dt = {dt:g}, but a step of the log takes {middle:g} (the median). Give time and dt "
            "in the same unit; of time stamps dt is in seconds, or in "
            f'time_unit="{[*fits, "min"][0]}".'
        )
    even = whole[~uneven]
    if len(even) > 0.9 * len(whole) and abs(even.mean() - dt) > 0.02 * dt:
        own = f"{even.mean():.4g}"
        warn(f"dt = {dt:g}, but a step of the log takes {own} on average: pass dt={own}.")
    if most or np.sum(uneven & (np.abs(whole - dt) < 0.5 * dt)) > 5 + 0.02 * len(whole):
        words = (
            f"{np.mean(uneven):.0%} of the log's steps differ from dt = {dt:g} by more than a "
            f"tenth, {middle:g} in the median: an episode ends at each, a model needs even ones. "
            "Put the readings on a grid of dt first, as historians and pandas' resample do."
        )
        if most:
            raise ValueError(words)
        warn(words)
    return found


def _near_grid(instants: Array, dt: float, around: int = 20) -> NDArray[np.bool_]:
    """Return which steps (T,) take dt to a tenth, or to 0.3 where the grid goes on beyond them.

    Stamps that jitter come back to their grid: its mean phase is the same on both sides of a step.
    """
    away = np.diff(instants) - dt
    around = min(around, len(away) // 2) or 1
    phase = np.cumsum(np.append(0.0, np.nan_to_num(away - dt * np.round(away / dt))))
    means = sliding_window_view(np.pad(phase, around - 1, "reflect"), around).mean(axis=1)
    goes_on = np.abs(means[around:] - means[:-around]) <= 0.1 * dt
    return np.asarray(np.abs(away) <= np.where(goes_on, 0.3, 0.1) * dt)


def as_matrices(name: str, value: Arrays, *, gaps: bool = False) -> list[Array]:
    """Return one float64 matrix for each episode, all with the same columns, NaN where allowed."""
    given = list(value) if isinstance(value, (list, tuple)) else []
    flat = [i for i, part in enumerate(given) if np.shape(part) != () and np.ndim(part) == 1]
    if flat and len({np.size(part) for part in given}) > 1:
        raise ValueError(
            f"{name} of episode {flat[0]} has shape {np.shape(given[flat[0]])}, expected "
            "(rows, columns). Of a single column write values.reshape(-1, 1)."
        )
    several = len(given) > 0 and np.ndim(given[0]) == 2
    if several or (array := to_float(name, value)).ndim == 3:
        parts = [to_float(f"{name} of episode {i}", part) for i, part in enumerate(value)]  # type: ignore[arg-type]
    else:
        parts = [array]
    for i, part in enumerate(parts):
        if part.ndim != 2 or not part.shape[1] or part.shape[1] != parts[0].shape[1]:
            raise ValueError(
                f"{name} of episode {i} has shape {part.shape}, expected (rows, columns) with the "
                "same columns in each episode. Of a single one write values.reshape(-1, 1)."
            )
        bad = np.flatnonzero(~np.all(np.abs(part) <= LARGEST_BOUND, axis=1))
        if bad.size and not (gaps and not np.isinf(part).any()):
            raise ValueError(
                f"{name} of episode {i} holds NaN or infinite entries in {bad.size} rows, first in "
                f"row {bad[0]}. Leave them out by splitting the episode there into two."
            )
    return parts
