"""Sensors that stand still while the plant moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sb3_yann._validation import Array

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
    told to rest by a linear model of the other rows. A clipped one rests at an end of its range.
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
