"""Which residual, and how strongly shrunk: by free runs over episodes that the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import labels_of
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.ensemble import NetworkResidual, fit_ensemble
from sb3_yann.twin.forecast import Judge, surely_worse
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Polynomial, Regressor, Residual, ZeroResidual

SHRINKAGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3}
INPUT_FACTORS = (1.0, 30.0)
MORE_THAN_A_POLYNOMIAL = 40.0
"""Freedom of networks: they are taken where they win."""
NETWORK = "network"
AHEAD = 20
"""Steps of the windows that networks are fitted to."""
ROWS, LACKS = 300, 0.01
"""Networks are tried on a log of so many steps, where the costs that all else predicts of held-out
episodes err by so much of the mean."""
NAMES = ("none", *DEGREES, NETWORK)
LONGEST = 100
"""Steps of a free run, at most."""
RUNS = 20
"""Free runs in an episode."""
FOLDS = 5


@dataclass(frozen=True)
class Candidate:
    """A kind of residual with its settings.

    Attributes
    ----------
    name : str
    make : callable
        Returns a residual that is not fitted.
    freedom : float
        How far it may leave the given model: of what predicts as well, the least free is taken.
    degree : int, default 1
        Of a polynomial.
    """

    name: str
    make: Callable[[], Any]
    freedom: float
    degree: int = 1


def candidates(problem: LinearMPC, kinds: Sequence[Any]) -> list[Candidate]:
    """Return what there is to choose from but networks; a kind is a name, or makes a regressor."""
    if isinstance(kinds, str) or not kinds:
        raise ValueError(f"residuals = {kinds!r} must be a list with at least one kind.")
    return [each for k in kinds if k != NETWORK for each in _of_a_kind(problem, k)]


def _of_a_kind(problem: LinearMPC, kind: Any) -> Iterator[Candidate]:
    offset = problem.layout.has_constants
    if kind == "none":
        yield Candidate("none", partial(ZeroResidual, problem.model.n_states), -np.inf)
    elif isinstance(kind, str) and kind in DEGREES:
        for shrinkage, factor in product(SHRINKAGES, INPUT_FACTORS):
            name = f"{kind}, shrinkage {shrinkage:g} ({shrinkage * factor:g} of inputs)"
            options = DEGREES[kind], shrinkage, offset, (problem.model.n_inputs, factor)
            freedom = DEGREES[kind] - 2 * np.log10(shrinkage) - np.log10(factor)
            yield Candidate(name, partial(Polynomial, *options), freedom, DEGREES[kind])
    elif callable(kind):
        name = getattr(kind, "__name__", type(kind).__name__)
        yield Candidate(name, partial(Regressor, kind), np.inf)
    else:
        raise ValueError(
            f"residuals holds {kind!r}; expected some of {NAMES}"
            ", or a function that makes a regressor with fit and predict."
        )


def fitted(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: Sequence[Episode],
    made: Sequence[Any],
) -> list[Residual]:
    """Return residuals fitted to what the linear model leaves of each step.

    Parameters
    ----------
    problem : LinearMPC
        Of the plant.
    coordinates : Coordinates
        What residuals are scaled by.
    episodes : sequence of Episode
        What they are fitted to.
    made : sequence
        Residuals that are not fitted yet.
    """
    z, y = zip(*(coordinates.regression(each) for each in episodes), strict=True)
    z_all, y_all = np.concatenate(z), np.concatenate(y)
    moments: dict[tuple[int, bool], Any] = {}  # which do not depend on the shrinkage
    for residual in made:
        if isinstance(residual, Polynomial):
            key = residual.degree, residual.offset
            if key not in moments:
                moments[key] = residual.moments(z_all, y_all)
            residual.solve(*moments[key])
        elif not isinstance(residual, ZeroResidual):
            residual.fit(z_all, y_all)
    return list(made)


@dataclass(frozen=True)
class FreeRuns:
    """Errors of free runs over episodes that were held out.

    Attributes
    ----------
    horizons : ndarray of int, shape (h,)
    by_episode : ndarray, shape (candidates, episodes, h)
        Root mean squares over states, in units of how far each moves in the log.
    names : tuple of str
    """

    horizons: Any
    by_episode: Array
    names: tuple[str, ...]

    @property
    def errors(self) -> Array:
        """Root mean squares over all episodes, (candidates, h)."""
        return np.asarray(np.sqrt(np.nanmean(self.by_episode**2, axis=1)))

    def only(self, number: int) -> FreeRuns:
        """Return those of one candidate."""
        one = slice(number, number + 1)
        return FreeRuns(self.horizons, self.by_episode[one], self.names[one])

    def from_number(self, first: int) -> FreeRuns:
        """Return those of the candidates from a number on."""
        return FreeRuns(self.horizons, self.by_episode[first:], self.names[first:])

    @property
    def scores(self) -> Array:
        """The mean logarithm over horizons, (candidates, episodes): less is better."""
        return np.asarray(np.nanmean(np.log(self.by_episode + 1e-12), axis=2))

    def choose(self, freedom: ArrayLike) -> int:
        """Return the least free candidate that is within one standard error of the best.

        The error is that of the difference of the two, over episodes (the one-standard-error rule
        of Hastie, Tibshirani and Friedman, section 7.10).
        """
        known = ~np.isnan(self.by_episode).all(axis=(0, 2))  # too short a piece says nothing
        scores = FreeRuns(self.horizons, self.by_episode[:, known], self.names).scores
        best = int(np.argmin(scores.mean(axis=1)))
        behind = scores - scores[best]
        error = behind.std(axis=1, ddof=1) / np.sqrt(behind.shape[1])
        near = behind.mean(axis=1) <= error
        near[best] = True
        return int(np.flatnonzero(near)[np.argmin(np.asarray(freedom)[near])])


@dataclass(frozen=True)
class Networks:
    """Networks of a log.

    Attributes
    ----------
    by_fold : tuple of NetworkResidual
        Each has not seen one fold of the episodes.
    members : tuple of NetworkResidual
        The first one has seen all, the others what was drawn.
    """

    by_fold: tuple[NetworkResidual, ...]
    members: tuple[NetworkResidual, ...]

    @classmethod
    def fit(
        cls,
        coordinates: Coordinates,
        parts: Sequence[Episode],
        drawn: Sequence[Sequence[Episode]],
        seed: int,
    ) -> Networks:
        """Return those of a log: one without each fold of its parts, one for each of the drawn."""
        kept = [[e for i, e in enumerate(parts) if i % FOLDS != k] for k in range(_folds(parts))]
        found = fit_ensemble(coordinates, [*kept, *drawn], seed, ahead=AHEAD)
        return cls(tuple(found[: len(kept)]), tuple(found[len(kept) :]))

    def compared(
        self, problem: LinearMPC, coordinates: Coordinates, parts: Sequence[Episode], runs: FreeRuns
    ) -> FreeRuns:
        """Return free runs of other candidates, with those of the networks behind them."""
        found = np.empty((1, *runs.by_episode.shape[1:]))
        for i, each in enumerate(parts):
            mine = [self.by_fold[i % FOLDS]]
            found[:, i] = np.sqrt(_errors(problem, coordinates, each, mine, runs.horizons))
        errors = np.concatenate([runs.by_episode, found])
        return FreeRuns(runs.horizons, errors, (*runs.names, NETWORK))


def networks_may_help(error: float, episodes: Sequence[Episode]) -> bool:
    """Return whether a log is long enough for networks, and lacks a model without them."""
    return sum(map(len, episodes)) >= ROWS and not error <= LACKS


def _folds(parts: Sequence[Episode]) -> int:
    return min(FOLDS, len(parts))


def held_out(
    problem: LinearMPC,
    coordinates: Coordinates,
    episodes: Sequence[Episode],
    choices: Sequence[Candidate],
) -> FreeRuns:
    """Return the free-run errors of candidates, over folds of whole episodes.

    Parameters
    ----------
    problem : LinearMPC
        Of the plant.
    coordinates : Coordinates
        What residuals are scaled by.
    episodes : sequence of Episode
        Each is left out once.
    choices : sequence of Candidate
        What is compared.
    """
    longest = min(LONGEST, int(np.median([*map(len, episodes)])))
    horizons = np.unique(np.geomspace(min(5, longest), longest, 6).astype(int))
    folds = [range(k, len(episodes), min(FOLDS, len(episodes))) for k in range(FOLDS)]
    errors = np.zeros((len(choices), len(episodes), len(horizons)))
    for fold in filter(len, folds):
        kept = [each for i, each in enumerate(episodes) if i not in fold]
        made = fitted(problem, coordinates, kept, [each.make() for each in choices])
        for i in fold:
            errors[:, i] = _errors(problem, coordinates, episodes[i], made, horizons)
    names = tuple(each.name for each in choices)
    return FreeRuns(horizons, np.sqrt(errors), names)


def choose(
    problem: LinearMPC,
    coordinates: Coordinates,
    log: Sequence[Episode],
    choices: Sequence[Candidate],
    first: int,
) -> tuple[FreeRuns, int]:
    """Return the candidates' free runs, and which is best, from number ``first`` on.

    Without a second episode it is the first.

    Parameters
    ----------
    problem : LinearMPC
        Of the plant.
    coordinates : Coordinates
        What residuals are scaled by.
    log : sequence of Episode
        Each is left out once.
    choices : sequence of Candidate
        What is compared.
    first : int
        Those before it are compared, and not chosen.
    """
    if len(log) < 2:
        errors = np.full((len(choices), 1, 1), np.inf)
        return FreeRuns(np.array([1]), errors, tuple(each.name for each in choices)), first
    runs = held_out(problem, coordinates, log, choices)
    freedom = [each.freedom for each in choices[first:]]
    return runs, first + runs.from_number(first).choose(freedom)


GAINS = (0.6, 1.7)
"""Times the model's: an input may act so, unless the log refutes it."""
LOOSE, FIRM = 1e-3, 1e3
"""Shrinkage of what fits a log around such a gain, and times as much of its inputs."""


def judges(
    coordinates: Coordinates,
    parts: Sequence[Episode],
    runs: FreeRuns,
    chosen: Candidate,
    own: Sequence[Residual],
) -> tuple[Judge, ...]:
    """Return the twins that a log does not refute: the chosen one, and those with other gains.

    In a closed loop a log may not tell the gain of an input, since the states follow it in many
    ways: whatever predicts held-out episodes within two standard errors of the chosen twin counts.

    Parameters
    ----------
    coordinates : Coordinates
        What residuals are scaled by.
    parts : sequence of Episode
        Each is left out once.
    runs : FreeRuns
        Those of the chosen twin, alone.
    chosen : Candidate
        What the twin is.
    own : sequence of Residual
        The chosen twin without each fold: see :func:`unseen`.
    """
    problem, n = coordinates.row.problem, coordinates.row.problem.model.n_states
    names, m = labels_of(problem.model)[1], problem.model.n_inputs
    offset, degree = problem.layout.has_constants, int(max(chosen.degree, 1))
    rivals, says = [], []
    for j, gain in product(range(m), GAINS):
        towards = np.zeros((len(coordinates.scale), n))
        scale = coordinates.scale[len(towards) - m + j]
        towards[len(towards) - m + j] = (gain - 1) * scale * problem.model.B[:, j]
        make = partial(Polynomial, degree, LOOSE, offset, (m, FIRM), towards)
        rivals.append(Candidate(f"{names[j]} times {gain:g}", make, 0.0, degree))
        says.append(f"a gain of {names[j]} {gain:g} times the model's, which the log allows,")
    behind = held_out(problem, coordinates, parts, rivals).scores - runs.scores
    found = [Judge(Dynamics(problem, coordinates, tuple(own)))]
    for rival, what, wrong in zip(rivals, says, surely_worse(behind), strict=True):
        members = tuple(unseen(coordinates, parts, rival))
        found.append(Judge(Dynamics(problem, coordinates, members), what, bool(wrong)))
    return tuple(found)


def unseen(coordinates: Coordinates, parts: Sequence[Episode], choice: Candidate) -> list[Residual]:
    """Return residuals of a choice, each fitted without one fold of the parts, if there are two."""
    if len(parts) < 2:
        return []
    kept = [[e for i, e in enumerate(parts) if i % FOLDS != k] for k in range(_folds(parts))]
    problem = coordinates.row.problem
    return [fitted(problem, coordinates, each, [choice.make()])[0] for each in kept]


def _errors(
    problem: LinearMPC,
    coordinates: Coordinates,
    episode: Episode,
    made: Sequence[Residual],
    horizons: Any,
) -> Array:
    """Return mean squares (candidates, h) of one episode's free runs."""
    found = np.full((len(made), len(horizons)), np.nan)
    horizons = horizons[horizons <= len(episode)]  # a short piece says nothing of more
    if not len(horizons):
        return found
    steps = int(horizons[-1])
    starts = np.unique(np.linspace(0, len(episode) - steps, RUNS).astype(int))
    actual = episode.thetas[starts[:, None] + horizons, coordinates.row.state]
    for same in _alike(made):
        dynamics = Dynamics(problem, coordinates, tuple(made[i] for i in same))
        with np.errstate(all="ignore"):
            free = dynamics.replay(episode, starts, steps)[:, :, horizons]
            error = (free - actual) / coordinates.units
            mean = np.mean(error**2, axis=(1, 3))
        found[same, : len(horizons)] = np.where(np.isfinite(mean), np.minimum(mean, 1e12), 1e12)
    return found


def _alike(made: Sequence[Residual]) -> list[list[int]]:
    """Return which residuals can be stepped as one: those of a kind, polynomials of one degree."""
    groups: dict[Any, list[int]] = {}
    for i, each in enumerate(made):
        stacks = hasattr(each, "stack")
        key = (type(each), getattr(each, "degree", 0)) if stacks else i
        groups.setdefault(key, []).append(i)
    return list(groups.values())
