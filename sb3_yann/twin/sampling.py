"""When a log was sampled: episodes are cut at gaps, another sampling time is refused."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float
from sb3_yann.twin.log import SHORTEST, Episode

GAP = 0.5
"""A step whose time differs from dt by more than this share of it is none."""
UNEVEN = 0.05
"""An episode's median step differs from dt by so much at most, relative to it."""


def cut_at_gaps(
    episodes: tuple[Episode, ...], time: Sequence[ArrayLike], dt: float
) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """Return episodes whose steps all take about dt, and notes of what was left out.

    Parameters
    ----------
    episodes : tuple of Episode
        The log.
    time : sequence of array_like, shape (T + 1,)
        When each row of an episode's states was measured, in the unit of dt.
    dt : float
        The model's sampling time.

    Raises
    ------
    ValueError
        For times that do not fit the states or do not increase, another sampling time than dt,
        or where no piece is long enough.
    """
    if len(time) != len(episodes):
        raise ValueError(f"time has {len(time)} entries for {len(episodes)} episodes.")
    parts, steps = list[Episode](), sum(map(len, episodes))
    gaps = 0
    for i, (episode, instants) in enumerate(zip(episodes, time, strict=True)):
        span = _steps(i, episode, instants)
        _require_sampling_time(i, float(np.median(span)), dt)
        at = np.flatnonzero(np.abs(span - dt) > GAP * dt)
        gaps += len(at)
        for before, end in pairwise([-1, *at, len(episode)]):
            rows = slice(before + 1, end)
            parts.append(Episode(episode.thetas[before + 1 : end + 1], episode.actions[rows]))
    kept = tuple(each for each in parts if len(each) >= SHORTEST)
    if not kept:
        raise ValueError(
            f"time cuts the log at {gaps} gaps into pieces of less than {SHORTEST} steps. "
            "Log episodes without gaps."
        )
    if not gaps:
        return kept, ()
    lost, short = steps - sum(map(len, kept)), len(parts) - len(kept)
    note = f"Cut at {gaps} gaps; {short} pieces of less than {SHORTEST} steps left out, "
    return kept, (f"{note}{lost} of {steps} steps in all.",)


def _steps(i: int, episode: Episode, instants: ArrayLike) -> Array:
    """Return how long each step of an episode took, (T,)."""
    t = to_float(f"episode {i}: time", instants)
    if t.shape != (len(episode) + 1,):
        wanted = f"({len(episode) + 1},), one for each row of states"
        raise ValueError(f"episode {i}: time has shape {t.shape}, expected {wanted}.")
    if not np.all(np.isfinite(t)):
        row = int(np.argmin(np.isfinite(t)))
        raise ValueError(
            f"episode {i}: time is {t[row]} in row {row}. Cut the episode there, into two of "
            "their own."
        )
    span = np.diff(t)
    if not np.all(span > 0):
        row = int(np.argmin(span > 0))
        raise ValueError(
            f"episode {i}: time does not increase after row {row}: {t[row]:g}, {t[row + 1]:g}. "
            "Sort the log, and leave out rows that stand there twice."
        )
    return span


def _require_sampling_time(i: int, median: float, dt: float) -> None:
    if abs(median - dt) > UNEVEN * dt:
        raise ValueError(
            f"episode {i}: a step takes {median:g} (the median), the model's takes dt = {dt:g}. "
            "Give time in the unit of dt, resample the log, or make the model for this sampling "
            "time: LinearModel.from_continuous(..., dt=), LinearModel.from_data(..., dt=)."
        )
