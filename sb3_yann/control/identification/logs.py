"""Measured episodes: checked, cut at gaps, and split into fitted and held-out steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float

Log = ArrayLike | Sequence[ArrayLike]
"""One array for each episode, or that of a single one."""
UNEVEN = 0.1  # largest deviation of a step's time from dt, relative to it


@dataclass(frozen=True, eq=False)
class Episode:
    """States (T+1, n), and the inputs and measured disturbances between them, (T, m+d)."""

    states: Array
    driven: Array

    def __len__(self) -> int:
        return int(self.driven.shape[0])

    @property
    def regressors(self) -> Array:
        """State, inputs and disturbances of each step, shape (T, n+m+d)."""
        return np.hstack([self.states[:-1], self.driven])

    def part(self, start: int, stop: int) -> Episode:
        """Return the steps from start to before stop."""
        return Episode(self.states[start : stop + 1], self.driven[start:stop])


def as_episodes(
    states: Log, actions: Log, disturbances: Log | None
) -> tuple[list[Episode], tuple[int, int, int]]:
    """Return the checked episodes and the sizes (n, m, d)."""
    x, u = _matrices("states", states), _matrices("actions", actions)
    none: list[Array] = [np.zeros((len(each), 0)) for each in u]
    d = none if disturbances is None else _matrices("disturbances", disturbances)
    for name, parts in (("actions", u), ("disturbances", d)):
        if len(parts) != len(x):
            raise ValueError(f"{name} has {len(parts)} episodes, states has {len(x)}.")
        for i, (part, state) in enumerate(zip(parts, x, strict=True)):
            if len(part) + 1 != len(state) or not len(part):
                raise ValueError(
                    f"{name} of episode {i} has {len(part)} rows, states has {len(state)}. "
                    "Expected T >= 1 and T + 1: the states before each action and after the last."
                )
    if sum(map(len, u)) < 2:
        raise ValueError(
            f"states has shape {x[0].shape} and actions {u[0].shape}: one step tells nothing. Rows "
            "are samples and columns states or inputs; transpose a log that has them otherwise."
        )
    episodes = [Episode(parts[0], np.hstack(parts[1:])) for parts in zip(x, u, d, strict=True)]
    return episodes, (x[0].shape[1], u[0].shape[1], d[0].shape[1])


def split(episodes: list[Episode], held_out: float) -> tuple[list[Episode], list[Episode]]:
    """Return what to fit and what to test: the last of all steps, cutting an episode if need be."""
    total = sum(map(len, episodes))
    left = total - max(1, round(held_out * total)) if held_out else total
    fitted, tested = [], []
    for episode in episodes:
        border = min(left, len(episode))
        left -= border
        fitted += [episode.part(0, border)] if border else []
        tested += [episode.part(border, len(episode))] if border < len(episode) else []
    return fitted, tested


def without_gaps(episodes: list[Episode], time: Log, dt: float) -> tuple[list[Episode], int]:
    """Return the episodes cut at steps that do not take dt, and the number of these steps."""
    times = _times(time)
    if len(times) != len(episodes):
        raise ValueError(f"time has {len(times)} episodes, states has {len(episodes)}.")
    parts, lost, spans = [], 0, []
    for i, (episode, instants) in enumerate(zip(episodes, times, strict=True)):
        if instants.shape != (len(episode) + 1,):
            wanted = f"({len(episode) + 1},): one for each row of states"
            raise ValueError(f"time of episode {i} has shape {instants.shape}, expected {wanted}.")
        span = np.diff(instants)
        if not np.all(span > 0):
            raise ValueError(
                f"time of episode {i} does not increase after row {int(np.argmax(~(span > 0)))}. "
                "Sort the log, and leave out rows that stand there twice."
            )
        gaps = np.flatnonzero(np.abs(span - dt) > UNEVEN * dt)
        edges = zip([-1, *gaps], [*gaps, len(episode)], strict=True)
        parts += [episode.part(a + 1, b) for a, b in edges if b > a + 1]
        lost += gaps.size
        spans.append(span)
    if 2 * lost > sum(map(len, episodes)):
        raise ValueError(
            f"dt = {dt:g}, but a step of the log takes {np.median(np.concatenate(spans)):g} (the "
            "median). Give time and dt in the same unit."
        )
    return parts, lost


def _times(value: Log) -> list[Array]:
    """Return one vector of times for each episode."""
    if isinstance(value, (list, tuple)) and len(value) > 0 and np.ndim(value[0]) == 1:
        return [to_float(f"time of episode {i}", part) for i, part in enumerate(value)]
    array = to_float("time", value)
    return list(array) if array.ndim == 2 else [array]


def _matrices(name: str, value: Log) -> list[Array]:
    """Return one float64 matrix for each episode, all with the same columns."""
    parts_given = list(value) if isinstance(value, (list, tuple)) else []
    flat = [i for i, part in enumerate(parts_given) if np.shape(part) != () and np.ndim(part) == 1]
    if flat and len({np.size(part) for part in parts_given}) > 1:
        raise ValueError(
            f"{name} of episode {flat[0]} has shape {np.shape(parts_given[flat[0]])}, expected "
            "(rows, columns). Of a single column write values.reshape(-1, 1)."
        )
    several = len(parts_given) > 0 and np.ndim(parts_given[0]) == 2
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
        bad = np.flatnonzero(~np.all(np.isfinite(part), axis=1))
        if bad.size:
            raise ValueError(
                f"{name} of episode {i} holds NaN or infinite entries in {bad.size} rows, first in "
                f"row {bad[0]}. Leave them out by splitting the episode there into two."
            )
    return parts
