"""A plant's log: episodes of a sampling time, checked and cut at gaps."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sb3_yann._validation import Array, check_int, check_positive, to_float, warn
from sb3_yann.log.csv_file import SECONDS, CsvFile
from sb3_yann.log.episodes import Arrays, Episode, in_names, records_of
from sb3_yann.log.readings import cleaned


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
        given = zip(self.sizes, ("state", "input", "disturbance"), names, strict=True)
        columns = [
            f"{size} {what}{'s' * (size > 1)}" + f" ({', '.join(of)})" * bool(of)
            for size, what, of in given
            if size
        ]
        steps = sum(map(len, self.episodes))
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
        return in_names(text, x=shown, y=shown, u=self.input_names, d=self.disturbance_names)

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
        starts = [(each, k) for each in self.episodes for k in range(0, len(each), steps)]
        return replace(self, episodes=tuple(each.part(k, k + steps) for each, k in starts))

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
        records = records_of({"states": states, "actions": inputs, "disturbances": disturbances})
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
        return cls._of(records_of(given, gaps=True), dt)

    @classmethod
    def _of(
        cls, records: list[Episode], dt: float, time: Arrays | None = None, **names: Any
    ) -> Log:
        """Return the log of records, cut at gaps and where a step takes another time."""
        dt = check_positive("dt", dt)
        records, empty = cleaned(records, names)
        on_time = None if time is None else _on_time(records, time, dt)
        episodes = _cut(records, _read_now_and_then(records), on_time)
        kept = sum(map(len, episodes))
        if not kept:
            words = "The log has no two samples in a row with all that is to be read"
            raise ValueError(f"{words}; never read: {', '.join(empty)}." if empty else f"{words}.")
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
        file = CsvFile(path, delimiter, decimal, encoding)
        of_episode, of_time = (each and file.column(each) for each in (episode, time))
        wanted = [file.column(name) for name in (*states, *inputs, *disturbances, *references)]
        if twice := [name for name in wanted if wanted.count(name) > 1]:
            raise ValueError(
                f"Column {twice[0]!r} is named twice. Each state, input and disturbance has a "
                "column of its own."
            )
        table = file.numbers(wanted)
        unread = [each for each in file.header if each not in wanted]
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
        labels = [row[of_episode] if of_episode else "" for row in file.rows]
        starts = [k for k in range(len(table)) if k == 0 or labels[k] != labels[k - 1]]
        edges = pairwise([*starts, len(table)])
        parts = [slice(first, stop) for first, stop in edges if stop - first > 1]
        records = [Episode(x[part], *(each[part][:-1] for each in others)) for part in parts]
        if not records:
            raise ValueError(f"{path} holds no two rows of an episode.")
        times = None
        if of_time is not None:
            instants, time_unit = file.times(of_time, time_unit)
            times = [instants[part] for part in parts]
        names, units = zip(*map(file.name_and_unit, wanted[: n + m + d]), strict=True)
        return cls._of(
            records,
            dt,
            times,
            state_names=names[:n],
            input_names=names[n : n + m],
            disturbance_names=names[n + m :],
            units=units if any(units) else (),
            time_unit=time_unit,
        )


def _read_now_and_then(records: Sequence[Episode]) -> NDArray[np.bool_]:
    """Return which states (n,) have isolated readings, as a laboratory's, or many short gaps."""
    read = np.isfinite(np.concatenate([each.states for each in records]))
    # A reading whose sample before has none begins a run; records count as one.
    runs = np.sum(read[1:] > read[:-1], axis=0) + read[0]
    count = np.sum(read, axis=0)
    # Isolated readings of less than two thirds of the samples: a state is read now and then.
    isolated = (count < 2 / 3 * len(read)) & (runs > count / 2)
    # With four readings or more, on average, between gaps, a state is cut at each; ten runs say so.
    return np.asarray((0 < count) & (isolated | ((runs >= 10) & (runs > count / 4))))


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
