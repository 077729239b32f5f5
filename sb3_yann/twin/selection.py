"""Which residual: none, a polynomial, or networks, by free runs over episodes held out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.forecast import Judge, surely_worse
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Residual

DEGREES = {"linear": 1, "quadratic": 2}
KINDS = ("none", *DEGREES, "network")
SHRINKAGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
INPUT_FACTORS = (1.0, 30.0)
"""How many times as strongly inputs are shrunk: the log of a closed loop shows little of them."""
LONGEST = 100
"""Steps of a free run, at most."""
RUNS = 20
"""Free runs in an episode."""
FOLDS = 5
GAINS = (0.6, 1.7)
"""Times the model's: an input may act so, unless the log refutes it."""
LOOSE, FIRM = 1e-3, 1e3
"""Shrinkage of what fits a log around such a gain, and times as much of its inputs."""


class Setting(NamedTuple):
    """How a polynomial is fitted.

    Attributes
    ----------
    degree : int
    shrinkage : float
        Weight of its squared coefficients, times the number of samples.
    factor : float
        How many times as strongly terms with an input are shrunk.
    gain : tuple of int and float, optional
        An input, and how many times as the model says it acts where it is shrunk to.
    """

    degree: int
    shrinkage: float
    factor: float
    gain: tuple[int, float] | None = None

    @property
    def freedom(self) -> float:
        """How far it may leave the given model."""
        return float(self.degree - 2 * np.log10(self.shrinkage) - np.log10(self.factor))

    def __str__(self) -> str:
        """Name the kind and the shrinkage."""
        kind = next(name for name, degree in DEGREES.items() if degree == self.degree)
        strongest = self.shrinkage * self.factor
        return f"{kind}, shrinkage {self.shrinkage:g} ({strongest:g} of inputs)"


@dataclass(frozen=True)
class Candidate:
    """A kind of residual.

    Attributes
    ----------
    name : str
    by_fold : tuple of Residual
        Residual k has not seen the episodes whose number is k modulo their count.
    setting : Setting, optional
        Of a polynomial.
    """

    name: str
    by_fold: tuple[Residual, ...]
    setting: Setting | None = None


def without_each_fold(parts: Sequence[Episode]) -> list[list[Episode]]:
    """Return episodes without each fold of them; none of a single one."""
    folds = range(min(FOLDS, len(parts))) if len(parts) > 1 else ()
    return [[e for i, e in enumerate(parts) if i % FOLDS != k] for k in folds]


def ridge(
    coordinates: Coordinates, episodes: Sequence[Episode], settings: Sequence[Setting]
) -> list[Residual]:
    """Return polynomials of some episodes, one for each setting.

    Where theta holds set-points or disturbances they have a constant term, which is not shrunk:
    else the equilibrium stays where it is.
    """
    z, y = map(np.concatenate, zip(*map(coordinates.regression, episodes), strict=True))
    problem, (count, k), n = coordinates.row.problem, z.shape, y.shape[1]
    i, j = np.triu_indices(k)
    quadratic = max(each.degree for each in settings) > 1
    F = np.hstack([z, np.ones((count, int(problem.layout.has_constants)))])
    linear = F.shape[1]
    F = np.hstack([F, z[:, i] * z[:, j]]) if quadratic else F
    gram, cross, found = F.T @ F, F.T @ y, []
    of_inputs = np.zeros(F.shape[1], dtype=bool)
    of_inputs[k - problem.model.n_inputs : k] = True
    of_inputs[linear:] = (j >= k - problem.model.n_inputs)[: len(of_inputs) - linear]
    for degree, shrinkage, factor, gain in settings:
        size = linear if degree == 1 else F.shape[1]
        weight = shrinkage * np.where(of_inputs[:size], factor, 1.0)
        weight[k:linear] = 1e-9
        matrix = linalg.cho_factor(gram[:size, :size] + count * np.diag(weight + 1e-12))
        about = np.zeros((size, n))
        if gain is not None:
            at = k - problem.model.n_inputs + gain[0]
            about[at] = (gain[1] - 1) * coordinates.scale[at] * problem.model.B[:, gain[0]]
        solved = about + linalg.cho_solve(matrix, cross[:size] - gram[:size, :size] @ about)
        Q: Array = np.zeros((k, k, n))
        if degree > 1:
            Q[i, j] = solved[linear:] / 2
            Q = Q + np.swapaxes(Q, 0, 1)
        found.append(Residual.polynomial(solved[:k], solved[k:linear].sum(axis=0), Q))
    return found


def candidates(
    coordinates: Coordinates, parts: Sequence[Episode], kinds: Sequence[str] = KINDS
) -> list[Candidate]:
    """Return the model as it is, and polynomials of some kinds, the least free first."""
    kept = without_each_fold(parts)
    n, k = coordinates.row.problem.model.n_states, len(coordinates.scale)
    degrees = [degree for kind, degree in DEGREES.items() if kind in kinds]
    settings = [Setting(*each) for each in product(degrees, SHRINKAGES, INPUT_FACTORS)]
    settings.sort(key=lambda each: each.freedom)
    fits = [ridge(coordinates, each, settings) for each in kept if settings]
    found = [Candidate("none", (Residual.zero(k, n),) * len(kept))]
    for number, each in enumerate(settings):
        found.append(Candidate(str(each), tuple(fit[number] for fit in fits), each))
    return found


@dataclass(frozen=True)
class FreeRuns:
    """Errors of free runs over episodes that were held out.

    Attributes
    ----------
    horizons : ndarray of int, shape (h,)
    by_episode : ndarray, shape (candidates, episodes, h)
        Root mean squares over states, in units of how far each moves in the log.
    """

    horizons: Any
    by_episode: Array

    @property
    def errors(self) -> Array:
        """Root mean squares over all episodes, (candidates, h)."""
        return np.asarray(np.sqrt(np.nanmean(self.by_episode**2, axis=1)))

    @property
    def scores(self) -> Array:
        """The mean logarithm over horizons, (candidates, episodes): less is better."""
        return np.asarray(np.nanmean(np.log(self.by_episode + 1e-12), axis=2))

    def only(self, number: int) -> FreeRuns:
        """Return those of one candidate."""
        return FreeRuns(self.horizons, self.by_episode[number : number + 1])

    def choose(self, first: int = 0) -> int:
        """Return the first candidate, from a number on, within one standard error of the best.

        The error is that of the difference of the two, over episodes (the one-standard-error rule
        of Hastie, Tibshirani and Friedman, section 7.10).
        """
        known = ~np.isnan(self.by_episode).all(axis=(0, 2))  # too short a piece says nothing
        scores = FreeRuns(self.horizons, self.by_episode[first:, known]).scores
        best = int(np.argmin(scores.mean(axis=1)))
        behind = scores - scores[best]
        error = behind.std(axis=1, ddof=1) / np.sqrt(behind.shape[1])
        near = behind.mean(axis=1) <= error
        near[best] = True
        return first + int(np.argmax(near))


def held_out(
    coordinates: Coordinates, parts: Sequence[Episode], choices: Sequence[Candidate]
) -> FreeRuns:
    """Return the errors of free runs of candidates over episodes, each without its fold."""
    if len(parts) < 2:
        return FreeRuns(np.array([1]), np.full((len(choices), 1, 1), np.inf))
    longest = min(LONGEST, int(np.median([*map(len, parts)])))
    horizons = np.unique(np.geomspace(min(5, longest), longest, 6).astype(int))
    errors = np.empty((len(choices), len(parts), len(horizons)))
    for i, episode in enumerate(parts):
        for same in _alike(choices):
            made = [choices[j].by_fold[i % FOLDS] for j in same]
            errors[same, i] = _errors(coordinates, episode, made, horizons)
    return FreeRuns(horizons, np.sqrt(errors))


def _alike(choices: Sequence[Candidate]) -> Iterator[list[int]]:
    """Yield which candidates can be stepped as one: those with hidden units, and those without."""
    plain = [each.by_fold[0].is_polynomial for each in choices]
    for kind in (True, False):
        if kind in plain:
            yield [i for i, each in enumerate(plain) if each == kind]


def _errors(
    coordinates: Coordinates, episode: Episode, made: Sequence[Residual], horizons: Any
) -> Array:
    """Return mean squares (candidates, h) of one episode's free runs."""
    found = np.full((len(made), len(horizons)), np.nan)
    horizons = horizons[horizons <= len(episode)]  # a short piece says nothing of more
    if not len(horizons):
        return found
    steps = int(horizons[-1])
    starts = np.unique(np.linspace(0, len(episode) - steps, RUNS).astype(int))
    actual = episode.thetas[starts[:, None] + horizons, coordinates.row.state]
    dynamics = Dynamics(coordinates.row.problem, coordinates, tuple(made))
    with np.errstate(all="ignore"):
        free = dynamics.replay(episode, starts, steps)[:, :, horizons]
        mean = np.mean(((free - actual) / coordinates.units) ** 2, axis=(1, 3))
    found[:, : len(horizons)] = np.where(np.isfinite(mean), np.minimum(mean, 1e12), 1e12)
    return found


def judges(
    coordinates: Coordinates, parts: Sequence[Episode], chosen: Candidate, runs: FreeRuns
) -> tuple[Judge, ...]:
    """Return the twins that a log may not refute: the chosen one, and those with other gains.

    In a closed loop a log may not tell the gain of an input, since the states follow it in many
    ways. The others are shrunk little: what the chosen one owes to its shrinkage shows as well.

    Parameters
    ----------
    coordinates : Coordinates
        What residuals are scaled by.
    parts : sequence of Episode
        Each is left out once.
    chosen : Candidate
        What the twin is.
    runs : FreeRuns
        Those of the chosen one, alone.
    """
    problem = coordinates.row.problem
    degree = 1 if chosen.setting is None else chosen.setting.degree
    names, others = labels_of(problem.model)[1], list[Setting]()
    for gain in product(range(len(names)), GAINS):
        others.append(Setting(degree, LOOSE, FIRM, gain))
    fits = [ridge(coordinates, each, others) for each in without_each_fold(parts)]
    rivals = [Candidate("", tuple(fit[i] for fit in fits)) for i in range(len(others))]
    worse = surely_worse(held_out(coordinates, parts, rivals).scores - runs.scores)
    found = [Judge(Dynamics(problem, coordinates, chosen.by_fold))]
    for rival, setting, wrong in zip(rivals, others, worse, strict=True):
        assert setting.gain is not None
        j, times = setting.gain
        says = f"a gain of {names[j]} {times:g} times the model's, which the log allows,"
        found.append(Judge(Dynamics(problem, coordinates, rival.by_fold), says, bool(wrong)))
    return tuple(found)
