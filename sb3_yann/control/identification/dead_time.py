"""Dead time: how many samples late each input acts, and its inputs on their way as states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.identification.innovations import dead_times, long_arx, no_effect, with_lags
from sb3_yann.control.identification.least_squares import Regression, stacked
from sb3_yann.control.identification.residuals import leftover, project_out
from sb3_yann.control.linear_system import names
from sb3_yann.log import Episode

MAX_DELAY = 10  # longest dead time in samples that is looked for


def as_delays(delay: int | str | Sequence[int], n_inputs: int) -> list[int] | None:
    """Return the dead time of each input in samples, None for "auto"."""
    if isinstance(delay, str):
        if delay != "auto":
            raise ValueError(f'delay = {delay!r} must be "auto" or a number of samples.')
        return None
    given = np.asarray(delay, dtype=object)
    values = given.ravel().tolist() * (n_inputs if given.ndim == 0 else 1)
    whole = [isinstance(v, (int, np.integer)) and not isinstance(v, bool) for v in values]
    if len(values) != n_inputs or not all(whole) or min(values) < 0:
        raise ValueError(
            f"delay = {delay!r} must be a whole number of samples, one for each of the {n_inputs} "
            'inputs, or "auto".'
        )
    return [int(v) for v in values]


def found_delays(episodes: list[Episode], n_inputs: int) -> list[int]:
    """Return the dead time of each input that the log shows: see `dead_times`.

    Long ARX models tell it from sensor noise and from curvature.
    """
    none = [0] * n_inputs
    longer = [episode for episode in episodes if len(episode) > MAX_DELAY + 1]
    rows = with_lags(longer, MAX_DELAY + 1, MAX_DELAY)
    n = episodes[0].states.shape[1]
    width = episodes[0].regressors.shape[1]
    if sum(map(len, rows)) <= 4 * (width + 1 + MAX_DELAY * n_inputs):
        return none
    best = dead_times(longer, MAX_DELAY, n_inputs)[0]
    if not any(best):
        return none
    known, target = stacked(rows)
    taps = [lag * width + n + j for j, delay in enumerate(best) for lag in range(1, delay + 1)]
    known = known[:, [*range(width), *taps]]
    # Behind sensor noise earlier inputs tell of the state, too, but it is the latest that acts.
    prompt = [
        _explained(known, n + j, target) > _explained(known, width + sum(best[: j + 1]) - 1, target)
        for j in range(n_inputs)
    ]
    # A dead time ends in a jump; behind sensor noise an effect only grows until it is seen.
    long = long_arx(longer, MAX_DELAY)[1]
    pick = np.eye(long.coefficients.shape[1])
    first = [lag * width + n + j for j, lag in enumerate(best)]
    found = [
        0 if each or (lag and no_effect(long, pick[[i]] - pick[[i - width]], 0.1)) else lag
        for lag, each, i in zip(best, prompt, first, strict=True)
    ]
    # A hidden state makes earlier inputs count too, but earlier states with them.
    return none if any(found) and leftover(longer, found).is_hidden else found


def _explained(regressors: Array, column: int, target: Array) -> float:
    """Return the sum over targets (k, n) of squared partial correlations with one column."""
    others = np.delete(regressors, column, axis=1)
    others = np.column_stack([np.ones(len(others)), others - others.mean(axis=0)])
    left = project_out(others, np.column_stack([target, regressors[:, column]]))
    sizes = np.sum(left**2, axis=0)
    explained = (left[:, :-1].T @ left[:, -1]) ** 2
    return float(np.sum(explained / np.maximum(sizes[:-1] * sizes[-1], np.finfo(float).tiny)))


def with_memory(episodes: Sequence[Episode], delays: Sequence[int]) -> list[Episode]:
    """Return the episodes with the last inputs, newest first, appended to the states.

    ``delays`` says how many of each input. Episodes shorter than the longest dead time fall out.
    """
    longest = max(delays)
    if not longest:
        return [*episodes]
    extended = []
    for episode in episodes:
        rows = len(episode) + 1 - longest
        if rows < 2:
            continue
        past = [
            episode.driven[longest - lag : longest - lag + rows, j]
            for j, delay in enumerate(delays)
            for lag in range(1, delay + 1)
        ]
        states = np.column_stack([episode.states[longest:], *past])
        extended.append(Episode(states, episode.inputs[longest:], episode.disturbances[longest:]))
    return extended


def longest_note(delays: Sequence[int]) -> str:
    """Return what to do where a dead time is the longest that is looked for; empty for others."""
    if max(delays, default=0) != MAX_DELAY:
        return ""
    return f" None beyond {MAX_DELAY} samples is looked for: pass it as delay, or sample slower."


def memory_labels(delays: Sequence[int], inputs: Sequence[str]) -> list[str]:
    """Return the names of the states that hold past inputs: ``u[0](k-1), u[0](k-2), ...``."""
    return [
        f"{name}(k-{lag})"
        for name, delay in zip(inputs, delays, strict=True)
        for lag in range(1, delay + 1)
    ]


def exact_memory(A: Array, B: Array, delays: Sequence[int], n: int) -> tuple[Array, Array]:
    """Return A and B with the rows of the past inputs, which shift, set to what they are.

    They were fitted with the n states and, after these, the inputs on their way.
    """
    A = A.copy()
    B = B.copy()
    A[n:] = np.eye(len(A), k=-1)[n:]
    B[n:] = 0.0
    late = [j for j, delay in enumerate(delays) if delay]
    first = n + np.cumsum([0, *(delays[j] for j in late)])[:-1]
    A[first] = 0.0
    B[first, late] = 1.0
    return A, B


EARLY = 0.1  # share of a state's squared errors that inputs of later rows leave, where they act


def early_note(episodes: Sequence[Episode], lags: int = 0) -> list[str]:
    """Return a note where states answer inputs of later rows, which no plant does.

    It is looked for where inputs are held: those of a feedback follow the noise of each sample.
    """
    most_early = 3  # rows by which inputs may stand too early, at most
    longer = [each for each in episodes if len(each) > lags + most_early + 1]
    moves = [np.any(np.diff(each.inputs, axis=0), axis=1) for each in longer]
    # Where inputs rest in a third of the rows, a feedback law did not answer noise.
    if not longer or np.mean(np.concatenate(moves)) > 2 / 3:
        return []
    left = []
    for early in range(most_early + 1):
        moved = []
        for each in longer:
            rows = len(each) - most_early
            moved.append(Episode(each.states[: rows + 1], each.inputs[early : rows + early]))
        known, after = stacked(with_lags(moved, lags + 1, lags))
        known = np.column_stack([np.ones(len(known)), known])
        if len(after) < 4 * known.shape[1]:
            return []
        left.append(np.mean(project_out(known, after) ** 2, axis=0))
    floor = 1e-10 * np.var(after, axis=0) + np.finfo(float).tiny
    shares = (np.array(left[1:]) + floor) / (left[0] + floor)
    least = np.mean(shares, axis=1)  # with earlier inputs beside, still later rows do as well
    early = int(np.argmax(least < np.min(least) + EARLY))
    if np.min(shares[early]) > EARLY or np.mean(shares[early]) > 1:
        return []
    share = 100 * np.min(shares[early])
    rows_later = f"{early + 1} row{'s' * (early > 0)}"
    return [
        f"The log answers inputs that stand {rows_later} later: with these the squared errors of "
        f"one step fall to {share:.2g} %. A row holds the inputs that act from it to the next row: "
        f"move all inputs {rows_later} up."
    ]


def input_notes(found: Regression, episodes: list[Episode]) -> list[str]:
    """Return notes on inputs and disturbances without effect, or with a delay.

    ``found`` is fitted without dead time to a part of the episodes.
    """
    n, m, d = found.sizes
    lags = found_delays(episodes, m + d)
    notes = []
    for column, (name, lag) in enumerate(zip(names(found.sizes)[n:], lags, strict=True), n):
        idle = no_effect(found, [column], 0.01)  # significance level of an input's effect
        if lag:
            start = f"{name} has no effect beyond chance, and t" if idle else "T"
            cure = f" Move its measurements {lag} samples down, in the log and on the plant."
            notes.append(
                f"{start}he residuals follow {name} of {lag} steps before: it acts {lag} samples "
                f"late.{cure if column >= n + m else ''}"
            )
        elif idle:
            notes.append(
                f"{name} has no effect on the next state beyond chance. Is it delayed by "
                "more than the log shows, too small beside the noise, or not what the plant got?"
            )
    if any(lags[:m]):
        notes.append(f"Pass delay={lags[:m] if m > 1 else lags[0]}, or delay='auto'.")
    return notes
