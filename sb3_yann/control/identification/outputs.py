"""Order and dead time of a model in innovation form, chosen by free runs over held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._progress import bar
from sb3_yann._validation import Array
from sb3_yann.control.identification.dead_time import MAX_DELAY
from sb3_yann.control.identification.innovations import (
    FLOOR,
    Chunks,
    Innovations,
    Past,
    dead_times,
    filtered,
    log_determinant,
    mean_square,
    refined,
    shifted,
    with_lags,
)
from sb3_yann.control.identification.least_squares import NOT_EXCITED
from sb3_yann.control.identification.residuals import TIED, project_out, within_rounding
from sb3_yann.log import Episode, split_episodes

RUN_AHEAD = 20  # samples of the free runs over held-out data


@dataclass(frozen=True, eq=False)
class Structure:
    """A model of outputs in scaled units, with what chose it."""

    model: Innovations
    delays: tuple[int, ...]
    error: float  # mean square of free runs, in spreads of the outputs; inf where there were none
    criterion: float  # Hannan and Quinn's, for each step
    start: tuple[Array, Array]  # mean (n,) and covariance (n, n) of the states
    fits: tuple[Array, Array]  # (q,) each, one and `RUN_AHEAD` steps ahead, in percent, or NaN
    refined: bool = False  # by prediction errors


def fit_structure(
    episodes: Sequence[Episode], order: int | None, delays: Sequence[int] | None, held_out: float
) -> tuple[Structure, Search]:
    """Return the model of scaled episodes whose order and dead times are given, or None to find.

    With it comes the search in all of the episodes.
    """
    read, tested = split_episodes(episodes, held_out)
    with bar("models of the outputs") as tries:
        if delays is None:
            searches = delayed(read, tested, order, tries)
        else:
            searches = [Search(read, tested, tuple(delays), tries)]
        found = min((each.best(order) for each in searches), key=lambda each: each.criterion)
        whole = Search(episodes, [], found.delays, tries, found)
        if whole.chunks.rare.any():  # the model tells more of slow outputs than a regression
            again = Search(read, tested, found.delays, tries, found).best(order)
            found = min(found, again, key=lambda each: each.criterion)
        final = whole.trial(min(found.model.order, whole.past.limit), refine=found.refined)
    return replace(found, model=final.model, start=final.start), whole


def delayed(
    read: Sequence[Episode], tested: Sequence[Episode], order: int | None, tries: Any
) -> list[Search]:
    """Return the search with the dead times that the outputs show, or several to choose from.

    Outputs that are read at each sample tell when an input begins to act on them. Others may follow
    it sooner: where there are some, no dead time is the other choice.
    """
    trials = [(0,) * read[0].inputs.shape[1]]
    fast = np.isfinite(np.concatenate([each.states for each in read])).all(axis=0)
    if not fast.any():
        return [Search(read, tested, trials[0], tries)]
    fitted = [replace(each, states=each.states[:, fast]) for each in read]
    judged = [replace(each, states=each.states[:, fast]) for each in tested]
    trials += [each for each in dict.fromkeys(dead_times(fitted, MAX_DELAY)) if any(each)]
    searches = [Search(fitted, judged, lags, tries) for lags in trials]
    rough = [each.rough(order) for each in searches]
    best = int(np.argmin([each.criterion for each in rough]))
    # Dead time must lower the criterion by 10 over all steps.
    sure = rough[best].criterion < rough[0].criterion - 10.0 / sum(map(len, fitted))
    # Nor is dead time taken where free runs err by 10 % more.
    if not sure or rough[best].error > rough[0].error * 1.1:
        best = 0
    if fast.all():
        return [searches[best]]
    return [Search(read, tested, lags, tries) for lags in dict.fromkeys((trials[0], trials[best]))]


def feedback(episodes: Sequence[Episode]) -> list[tuple[int, float]]:
    """Return the inputs that follow earlier outputs, and what share of them does not.

    ValueError for an input that is a function of earlier outputs and inputs alone, all as rounded.
    """
    no_move = 1e-12
    lags = 4  # earlier samples of which an input may be a function
    q, m, d = episodes[0].sizes
    width = q + m + d
    rows = [each.regressors for each in with_lags(episodes, lags + 1, lags)]
    if sum(map(len, rows)) <= 10 * lags * width:
        return []
    whole = np.concatenate(rows)
    spread = whole.std(axis=0)
    still = spread <= no_move * np.abs(whole).max(axis=0)
    whole = (whole - whole.mean(axis=0)) / np.where(still, 1.0, spread)
    past = whole.reshape(-1, lags + 1, width)
    now = past[:, 0, q : q + m]
    own = np.column_stack([np.ones(len(now)), past[:, 1:, q : q + m].reshape(len(now), -1)])
    known = np.hstack([own, past[..., :q].reshape(len(now), -1)])
    alone = np.mean(project_out(own, now) ** 2, axis=0)
    left = np.mean(project_out(known, now) ** 2, axis=0) / np.maximum(alone, no_move)
    moves = alone > no_move  # of scaled inputs
    tied = moves & ((left < no_move) | (within_rounding(known, now) & (left < TIED)))
    if tied.any():
        raise ValueError(
            f"u[{np.argmax(tied)}] is a function of earlier outputs and inputs, to within their "
            f"rounding: a feedback law alone sets it. {NOT_EXCITED}"
        )
    # Where a feedback law leaves less than a tenth of an input, the notes say so.
    return [(j, float(left[j])) for j in range(m) if moves[j] and left[j] < 0.1]


class Search:
    """Models of each order for given dead times; a bar counts them."""

    def __init__(
        self,
        read: Sequence[Episode],
        tested: Sequence[Episode],
        delays: tuple[int, ...],
        tries: Any,
        earlier: Structure | None = None,
    ) -> None:
        self.tries = tries
        self.fitted = shifted(read, delays)
        self.tested = shifted(tested, delays)
        self.chunks = Chunks(self.fitted)
        self.delays = delays
        # Of delayed inputs, or stand-ins would answer too soon.
        self.past = Past(stand_ins(self.fitted, earlier), self.chunks.rare)
        self.largest = min(16, self.past.limit)
        self.tried: list[Structure] = []

    def rough(self, order: int | None) -> Structure:
        """Return the best model by subspaces alone."""
        for n in range(1, self.largest + 1) if order is None else [min(order, self.past.limit)]:
            self.tried.append(self.assessed(self.past.model(n)))
            best = int(np.argmin([each.criterion for each in self.tried]))
            # After four orders without a better criterion none is tried any more.
            if len(self.tried) - best > 4:
                break
        return self.tried[best]

    def best(self, order: int | None) -> Structure:
        """Return the best model near the rough one, or one nearly as good that runs far better."""
        if not self.tried:
            self.rough(order)
        start = min(self.tried, key=lambda each: each.criterion).model.order
        found = {start: self.trial(start)}
        for step in (-1, 1) if order is None else ():
            n = start + step
            while 1 <= n <= self.largest:
                found[n] = self.trial(n)
                if found[n].criterion > found[n - step].criterion:
                    break
                n += step
        best = min(found.values(), key=lambda each: each.criterion)
        # Errors of one step may be 5 % larger: .1 in the criterion, for each output.
        limit = best.criterion + 0.1 * len(best.model.C)
        rough = [] if self.chunks.rare.any() else self.tried  # those read slow outputs never
        near = [each for each in (*rough, *found.values()) if each.criterion <= limit]
        free = min(near, key=lambda each: each.error)
        # Another than the criterion's choice must lower the mean square of free runs by 15 %.
        return free if free.error < 0.85 * best.error else best

    def trial(self, order: int, *, refine: bool = True) -> Structure:
        """Return the model of an order, refined where that lowers the criterion.

        Outputs that are read now and then the rough one knows by stand-ins alone.
        """
        rough = self.assessed(self.past.model(order))
        if not refine or not np.isfinite(rough.criterion):
            return rough
        found = replace(self.assessed(refined(rough.model, self.chunks)), refined=True)
        slow = self.chunks.rare.any() and np.isfinite(found.criterion)
        return found if slow or found.criterion < rough.criterion else rough

    def assessed(self, model: Innovations) -> Structure:
        """Return a model with its criterion and its free runs over held-out data."""
        self.tries.update()
        q = len(model.C)
        if not self.chunks.forgets(model):
            none = np.full(q, np.nan)
            nowhere = np.zeros(model.order), np.eye(model.order)
            return Structure(model, self.delays, np.inf, np.inf, nowhere, (none, none))
        start = self.chunks.spread(model)

        def ahead(steps: int) -> tuple[Array, Array]:
            longer = [each for each in self.tested if len(each) > steps]
            targets = [each.states[steps:] for each in longer]
            guesses = [predicted(model, each, start, steps) for each in longer]
            return missed(targets, guesses, q, least=10)

        with np.errstate(all="ignore"):
            errors, long = ahead(RUN_AHEAD)
            fits = ahead(1)[1], long
            criterion = self.criterion(model, start)
        both = np.mean(errors**2), criterion
        error, size = (float(x) if np.isfinite(x) else np.inf for x in both)
        return Structure(model, self.delays, error, size, start, fits)

    def criterion(self, model: Innovations, start: tuple[Array, Array]) -> float:
        """Return Hannan and Quinn's criterion (J. R. Stat. Soc. B 41, 1979), of whole records.

        The chunks' own first states would count as parameters.
        """
        # A record's first samples say where it began, not how the plant moves.
        parts = []
        for each in self.fitted:
            left = each.states[1:] - predicted(model, each, start, 1)
            # A filter finds the first state within thirty samples.
            parts.append(left[min(30, len(each) // 5) :])
        errors = np.concatenate(parts)
        read = ~np.isnan(errors)
        steps, q = errors.shape
        # A change of the states' coordinates moves the other parameters.
        count = model.order * (model.B.shape[1] + 2 * q)
        noise = mean_square(np.where(read, errors, 0.0), read) + FLOOR * np.eye(q)
        size = log_determinant(noise, read.sum(axis=0))
        return float(size + 2 * np.log(np.log(max(steps, 16))) * count / steps)


def missed(
    targets: Sequence[Array], guesses: Sequence[Array], size: int, least: int = 1
) -> tuple[Array, Array]:
    """Return the root mean square (size,) of what guesses miss, and the fit in percent.

    Targets may be NaN. The fit is NaN where no column has so many at ``least``, and of a constant.
    """
    none = np.zeros((0, size))
    target = np.concatenate([none, *targets])
    left = target - np.concatenate([none, *guesses])
    with np.errstate(invalid="ignore"):
        count = np.isfinite(target).sum(axis=0)
        away = target - np.nansum(target, axis=0) / count
        errors, moved = (np.sqrt(np.nansum(each**2, axis=0) / count) for each in (left, away))
        known = (moved > 0) & (count.max() >= least)
        return errors, 100 * (1 - errors / np.where(known, moved, np.nan))


def predicted(
    model: Innovations, episode: Episode, start: tuple[Array, Array], ahead: int
) -> Array:
    """Return the outputs (T + 1 - ahead, q) so many samples ahead of those that are known."""
    moved = episode.driven @ model.B.T + model.c
    x = filtered(model, episode.states, moved, start)[1:]
    rows = len(episode) + 1 - ahead
    x = x[:rows]
    for step in range(1, ahead):
        x = x @ model.A.T + moved[step : step + rows]
    return np.asarray(x @ model.C.T + model.y_0)


def stand_ins(episodes: Sequence[Episode], earlier: Structure | None = None) -> list[Episode]:
    """Return episodes whose slow outputs, NaN but now and then, have a value at each sample.

    That is what a model tells, or else a regression, and what it leaves at the readings, drawn
    straight from one to the next.
    """
    slow = ~np.isfinite(np.concatenate([each.states for each in episodes])).all(axis=0)
    if not slow.any():
        return list(episodes)
    if earlier is None or not np.isfinite(earlier.criterion):
        guesses = _regressed(episodes, slow)
    else:
        first = earlier.model.C @ earlier.start[0] + earlier.model.y_0
        ahead = [predicted(earlier.model, each, earlier.start, 1) for each in episodes]
        guesses = [np.vstack([first, each]) for each in ahead]
    filled = []
    for each, guess in zip(episodes, guesses, strict=True):
        left = each.states - guess
        rows = np.arange(len(guess))
        for column in left.T:
            seen = np.isfinite(column)
            column[:] = np.interp(rows, rows[seen], column[seen]) if seen.any() else 0.0
        filled.append(replace(each, states=guess + left))
    return filled


def _regressed(episodes: Sequence[Episode], slow: NDArray[np.bool_]) -> list[Array]:
    """Return outputs (T + 1, q), the slow ones as linear functions of the others and the inputs.

    These are taken as of now, of inputs as of before, and filtered by several time constants.
    """
    from scipy.signal import lfilter  # takes half a second to import

    y = np.concatenate([each.states for each in episodes])
    longest = 8 / max(np.mean(np.isfinite(y[:, slow])), 1e-3)
    constants = np.exp2(np.arange(max(3, int(np.log2(longest)) + 1), dtype=np.float64))
    parts = []
    for each in episodes:
        before = np.vstack([each.driven[:1], each.driven])  # acts from the second sample on
        signals = np.hstack([each.states[:, ~slow], before])
        smooth = [
            lfilter([1 - pole], [1, -pole], signals, axis=0, zi=pole * signals[:1])[0]
            for pole in np.exp(-1 / constants)
        ]
        parts.append(np.hstack([signals, *smooth]))
    rows = np.concatenate(parts)
    scale = rows.std(axis=0)
    rows = (rows - rows.mean(axis=0)) / np.where(scale > 0, scale, 1.0)
    found = y.copy()
    for i in np.flatnonzero(slow):
        at = np.isfinite(y[:, i])
        count = max(at.sum(), 1)  # the part that is fitted may have none
        mean = y[at, i].sum() / count
        # A ridge of 1e-3 of the number of readings: filtered signals depend on each other.
        gram = rows[at].T @ rows[at] + 1e-3 * count * np.eye(rows.shape[1])
        found[:, i] = mean + rows @ np.linalg.solve(gram, rows[at].T @ (y[at, i] - mean))
    return np.split(found, np.cumsum([*map(len, parts)])[:-1])
