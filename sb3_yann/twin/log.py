"""A plant's own episodes, checked, in the parts of theta; and who estimates its disturbances."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, to_float, warn
from sb3_yann.control import LinearMPC
from sb3_yann.log import SECONDS, Log, as_matrices, require_one_state_more

SHORTEST = 5  # steps that an episode has at least


@dataclass(frozen=True)
class Episode:
    """One episode without gaps.

    Attributes
    ----------
    thetas : ndarray, shape (T + 1, n_theta)
        ``[x, r, d, u_prev]`` at each sample, as the law sees it. In a twin with an observer these
        are rows (T + 1, size): see :class:`RowLayout`.
    actions : ndarray, shape (T, m)
        The inputs, in the units of the problem.
    seed : int, optional
        Of a simulator. What is random is the same in episodes of the same seed.
    """

    thetas: Array
    actions: Array
    seed: int | None = None

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.actions)


def as_episodes(
    problem: LinearMPC,
    episodes: Iterable[tuple[ArrayLike, ArrayLike]],
    references: Sequence[ArrayLike] | None = None,
    disturbances: Sequence[ArrayLike] | None = None,
) -> tuple[Episode, ...]:
    """Return episodes, given in plant units, as the law sees them: in deviations.

    States are (T + 1, n), or all of theta; references (T + 1, p) and disturbances (T + 1, d) what
    theta holds besides, one for each episode, or one row for all of it. The input before each
    episode is that of the operating point. Wrong shapes, entries that are not finite and inputs
    beyond their bounds are a ValueError.
    """
    layout = problem.layout
    pairs = zip(*as_pairs(episodes), strict=True)
    # A list of numbers is one column.
    states, actions = (
        as_matrices(name, [np.reshape(x, (-1, 1)) if np.ndim(x) == 1 else x for x in parts])
        for name, parts in zip(("states", "actions"), pairs, strict=True)
    )
    require_one_state_more("actions", actions, states)
    given = {"references": references, "disturbances": disturbances}
    beside = {name: values for name, values in given.items() if values is not None}
    for name, values in beside.items():
        if not hasattr(values, "__len__"):
            raise TypeError(f"{name} must be a list with an entry for each episode.")
        if len(values) != len(states):
            raise ValueError(f"{name} has {len(values)} entries for {len(states)} episodes.")
    if states[0].shape[1] not in (layout.n_states, layout.size):
        raise ValueError(
            f"states have {states[0].shape[1]} columns, the problem {layout.n_states} states, and "
            f"theta {layout.size} entries. Past inputs are states where the model has them: see "
            "sb3_yann.wrappers.PastInputs."
        )
    if actions[0].shape[1] != problem.model.n_inputs:
        raise ValueError(
            f"actions have {actions[0].shape[1]} columns, the problem {problem.model.n_inputs} "
            "inputs."
        )
    whole = states[0].shape[1] == layout.size > layout.n_states
    if whole and beside:
        raise ValueError(f"{[*beside]} is given, but states are all of theta: leave it out.")
    found = []
    room = 1e-3 * problem.u_half
    for i, (x, u) in enumerate(zip(states, actions, strict=True)):
        if len(u) < SHORTEST:
            raise ValueError(f"episode {i} has {len(u)} steps; {SHORTEST} are the least.")
        for row, k in np.argwhere((u < problem.u_min - room) | (u > problem.u_max + room)):
            raise ValueError(
                f"episode {i}: action {k} is {u[row, k]:g} in row {row}, beyond the bounds "
                f"{problem.u_min[k]:g} and {problem.u_max[k]:g} of the problem. A log is in plant "
                "units where the model has an operating point, and in its own where it has none."
            )
        u = problem.units.input_to_deviations(np.clip(u, problem.u_min, problem.u_max))
        x = problem.units.to_deviations(x)
        own = {name: values[i] for name, values in beside.items()}
        found.append(Episode(x if whole else _theta(problem, i, x, u, own), u))
    return tuple(found)


def fingerprint(pairs: Sequence[tuple[ArrayLike, ArrayLike]]) -> str:
    """Return a line with the SHA-256 of a log's states and inputs."""
    digest = hashlib.sha256()
    for array in chain.from_iterable(pairs):
        digest.update(np.asarray(array, np.float64).tobytes())
    return f"Fingerprint of its states and inputs (SHA-256): {digest.hexdigest()[:16]}."


def without_copies(episodes: tuple[Episode, ...]) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """Return each episode once, and a note: a copy would test the twin on what it has seen."""
    kept = {(each.thetas.tobytes(), each.actions.tobytes()): each for each in episodes}
    if len(kept) == len(episodes):
        return episodes, ()
    return (*kept.values(),), (f"Left out {len(episodes) - len(kept)} copies of other episodes.",)


def without_short_pieces(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return a log without episodes of few steps, which gaps leave, and a note."""
    kept = tuple(each for each in log.episodes if len(each) >= SHORTEST)
    if not kept or len(kept) == len(log):
        return log, ()
    note = f"Left out {len(log) - len(kept)} pieces of less than {SHORTEST} steps"
    return replace(log, episodes=kept), (f"{note}; {log.lost_steps} steps were gaps.",)


def pieces(episodes: tuple[Episode, ...], least: int) -> tuple[Episode, ...]:
    """Return at least so many pieces of two episodes or more: whole ones where there are enough.

    Each piece of an episode begins where the one before it ends.
    """
    if len(episodes) < 2 or len(episodes) >= least:
        return episodes
    found = []
    for episode in episodes:
        count = min(-(-least // len(episodes)), max(1, len(episode) // (4 * SHORTEST)))
        for first, last in pairwise(np.linspace(0, len(episode), count + 1).astype(int)):
            found.append(Episode(episode.thetas[first : last + 1], episode.actions[first:last]))
    return tuple(found)


def records(problem: LinearMPC, episodes: tuple[Episode, ...]) -> list[range]:
    """Return the numbers of the episodes of each record: one begins where the one before ends.

    Two neighbors share a state and what the plant remembers. Every other one is independent.
    """
    n = problem.model.n_states  # references may change where a record is cut
    follows = [np.array_equal(a.thetas[-1, :n], b.thetas[0, :n]) for a, b in pairwise(episodes)]
    edges = [0, *(np.flatnonzero(~np.array(follows, dtype=bool)) + 1), len(episodes)]
    return [range(int(first), int(stop)) for first, stop in pairwise(edges)]


def more_of(problem: LinearMPC, episodes: tuple[Episode, ...], count: int) -> str:
    """Return how much so many independent episodes are: of one record, its rows, and hours."""
    whole = records(problem, episodes)
    if len(whole) > 1 or len(episodes) == 1:
        return f"{count} episodes"
    rows = 10 * round(count * sum(map(len, episodes)) / len(whole[0][::2]) / 10)
    hours = rows * problem.model.dt * SECONDS.get(problem.model.time_unit, 0) / 3600
    return f"{rows:,} rows" + f" ({hours:.3g} h)" * (hours > 0)


def as_pairs(episodes: Iterable[Any]) -> list[tuple[Any, Any]]:
    """Return states and actions of each episode."""
    if not isinstance(episodes, Iterable):
        raise TypeError(
            f"episodes must be a list of pairs (states, actions), got {type(episodes).__name__}. "
            "Of what evaluate returns: zip(log.observations, log.actions)."
        )
    pairs = [*episodes]
    if not pairs:
        raise ValueError("episodes is empty: pass a list of (states, actions), one per episode.")
    for i, pair in enumerate(pairs):
        if not (isinstance(pair, tuple | list) and len(pair) == 2):
            raise TypeError(f"episode {i} must be a pair (states, actions), got {type(pair)}.")
    return [(states, actions) for states, actions in pairs]


def _theta(problem: LinearMPC, i: int, x: Array, u: Array, given: dict[str, Any]) -> Array:
    layout = problem.layout
    point = problem.theta_ss
    theta = np.zeros((len(x), layout.size))
    theta[:, layout.state] = x
    p = layout.n_references
    for name, part in (("references", slice(0, p)), ("disturbances", slice(p, None))):
        size = len(layout.now[part])
        if name not in given:
            if size:
                raise ValueError(
                    f"The problem's theta holds {size} {name}: pass {name}=, shape (T + 1, "
                    f"{size}) for each episode, or states of all of theta. Of a CSV file, name the "
                    f"columns: Log.from_csv(..., {name}=[...])."
                )
            continue
        values = to_float(f"{name} of episode {i}", given[name])
        if values.ndim == 1 and size == 1 and len(values) == len(x):
            values = values[:, None]
        values = np.atleast_2d(values)
        if values.shape not in ((1, size), (len(x), size)) or not np.all(np.isfinite(values)):
            raise ValueError(
                f"{name} of episode {i} have shape {values.shape}, expected ({len(x)}, {size}), or "
                "entries that are no finite numbers."
            )
        values = np.broadcast_to(values - point[layout.now[part]], (len(x), size))
        for ahead in reversed(range(max(layout.previews) + 1)):  # what came is what was foreseen
            rows = np.minimum(np.arange(len(x)) + ahead, len(x) - 1)
            theta[:, layout.sample(ahead)[part]] = values[rows]
    if layout.n_previous:
        theta[1:, layout.previous] = u
    return theta


def warn_of_estimates(problem: LinearMPC, episodes: Sequence[Episode]) -> None:
    """Warn where the disturbances of a log move as those of an observer.

    An observer moves its estimate by a fixed matrix times what the model does not predict.
    """
    parts = problem.layout
    own = problem.deviations
    if not parts.n_disturbances:
        return
    d_min, d_max = (each[parts.disturbance] for each in (own.theta_min, own.theta_max))
    # An estimate may lie beyond its bound by 1e-6 of the bounds' distance.
    room = 1e-6 * (d_max - d_min)
    errors = []
    moves = []
    for each in episodes:
        d = each.thetas[:, parts.disturbance]
        free = np.all((d > d_min + room) & (d < d_max - room), axis=1)
        free = free[1:] & free[:-1]
        left = each.thetas[1:] - own.predict(each.thetas[:-1], each.actions)
        errors.append(left[free, parts.state])
        moves.append(np.diff(d, axis=0)[free])
    e = np.concatenate(errors)
    moved = np.concatenate(moves)
    half = problem.theta_half[parts.disturbance]
    if len(e) <= 2 * parts.n_states or not np.any(np.std(moved, axis=0) > 1e-6 * half):
        return
    left = moved - e @ np.linalg.lstsq(e, moved, rcond=None)[0]
    # 1e-3: an estimate's moves follow the model's errors but for so much of their squares
    if np.sum((left / half) ** 2) <= 1e-3 * np.sum((moved / half) ** 2):
        warn(
            "The disturbances of the log follow the model's errors, as an observer's estimate "
            "does. A twin takes them for measured ones, which the policy does not move. Pass "
            "observer=, the one of ObserveDisturbance."
        )
