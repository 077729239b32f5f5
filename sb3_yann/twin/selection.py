"""Which residual, and how strongly shrunk: by free runs over episodes that the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.gaussian_process import GaussianProcess
from sb3_yann.twin.log import Episode
from sb3_yann.twin.network import Network
from sb3_yann.twin.residuals import Nothing, Polynomial, Regressor, Residual

SHRINKAGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3}
INPUT_FACTORS = (1.0, 30.0)
STIFFNESSES = (1.0, 10.0, 100.0)
DECAYS = (1e-4, 1e-3, 1e-2)
MORE_THAN_A_POLYNOMIAL = 20.0
"""Freedom of a Gaussian process, and half that of a network: they are taken where they win."""
NAMES = ("none", *DEGREES, "gaussian process", "network")
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
    """

    name: str
    make: Callable[[], Any]
    freedom: float


def candidates(
    problem: LinearMPC, kinds: Sequence[Any], rng: np.random.Generator
) -> list[Candidate]:
    """Return what there is to choose from; a kind is a name, or makes something with fit."""
    if isinstance(kinds, str) or not kinds:
        raise ValueError(f"residuals = {kinds!r} must be a list with at least one kind.")
    return [each for kind in kinds for each in _of_a_kind(problem, kind, rng)]


def _of_a_kind(problem: LinearMPC, kind: Any, rng: np.random.Generator) -> Iterator[Candidate]:
    offset = problem.layout.has_constants
    if kind == "none":
        yield Candidate("none", partial(Nothing, problem.model.n_states), -np.inf)
    elif isinstance(kind, str) and kind in DEGREES:
        for shrinkage, factor in product(SHRINKAGES, INPUT_FACTORS):
            name = f"{kind}, shrinkage {shrinkage:g} ({shrinkage * factor:g} of inputs)"
            options = DEGREES[kind], shrinkage, offset, (problem.model.n_inputs, factor)
            freedom = DEGREES[kind] - 2 * np.log10(shrinkage) - np.log10(factor)
            yield Candidate(name, partial(Polynomial, *options), freedom)
    elif kind == "gaussian process":
        for stiffness in STIFFNESSES:
            process = partial(GaussianProcess, offset, stiffness)
            freedom = MORE_THAN_A_POLYNOMIAL - np.log10(stiffness)
            yield Candidate(f"{kind}, stiffness {stiffness:g}", process, freedom)
    elif kind == "network":
        for decay in DECAYS:
            network = partial(Network, rng, decay, offset)
            freedom = 2 * MORE_THAN_A_POLYNOMIAL - np.log10(decay)
            yield Candidate(f"{kind}, decay {decay:g}", network, freedom)
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
    z, y = zip(*(regression(coordinates, each) for each in episodes), strict=True)
    z_all, y_all = np.concatenate(z), np.concatenate(y)
    moments: dict[tuple[int, bool], Any] = {}  # which do not depend on the shrinkage
    for residual in made:
        if isinstance(residual, Polynomial):
            key = residual.degree, residual.offset
            if key not in moments:
                moments[key] = residual.moments(z_all, y_all)
            residual.solve(*moments[key])
        elif not isinstance(residual, Nothing):
            residual.fit(z_all, y_all)
    return list(made)


def regression(coordinates: Coordinates, episode: Episode) -> tuple[Array, Array]:
    """Return z (T, k), and what the linear model leaves of the next states (T, n)."""
    row, rows, u = coordinates.row, episode.thetas, episode.actions
    linear = np.concatenate([rows[:-1], u], axis=1) @ row.linear[row.state].T
    return coordinates.scaled(row.features(rows[:-1], u)), rows[1:, row.state] - linear


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

    @property
    def scores(self) -> Array:
        """The mean logarithm over horizons, (candidates, episodes): less is better."""
        return np.asarray(np.nanmean(np.log(self.by_episode + 1e-12), axis=2))

    def choose(self, freedom: Array) -> int:
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
        return int(np.flatnonzero(near)[np.argmin(freedom[near])])


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
    asked = FreeRuns(runs.horizons, runs.by_episode[first:], runs.names[first:])
    return runs, first + asked.choose(np.array([each.freedom for each in choices[first:]]))


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
