"""Episodes of states, inputs and measured disturbances, and what makes them of arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import LARGEST_BOUND, Array, to_float

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


def records_of(given: dict[str, Arrays | None], *, gaps: bool = False) -> list[Episode]:
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
