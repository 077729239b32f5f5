"""What the watchdog compares with: runs of the twin beside the plant, and how far they may err."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.commissioning.predictive_variance import PredictiveVariance
from sb3_yann.twin.dynamics import Dynamics, law_of
from sb3_yann.twin.ensemble import NetworkResidual, fit_ensemble
from sb3_yann.twin.log import Episode, pieces
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.residuals import Residual
from sb3_yann.twin.selection import AHEAD, fitted
from sb3_yann.twin.trust import costs_of

GAINS = np.array([1.0, 0.2, 0.05, 0.02])
"""Of the observers: one without a memory, others with one of 5, 20 and 50 samples."""
FOLDS = 10
FEWEST = 4
"""Whole episodes to leave out one by one; of fewer, pieces are left out."""
COST_FLOOR, COST_ERROR = 1.0, 0.03
"""Of the mean cost of an episode, and of what is predicted: what no cost band is narrower than."""
FACTOR, FACTOR_OF_FEW = 2.0, 7.5
"""A band is so many times the largest held-out ratio: 2 + 7.5 / episodes."""
LEAST_RATIO = 0.5
"""The largest ratio is taken to be at least this, however well the log is predicted."""
NOISY = 0.3
"""Correlation of successive errors below which they are noise; those of a model change slowly."""

Act = Callable[[Array], Array]


@dataclass
class EwmaCharts:
    """Runs of the twin beside the plant, in one episode.

    For each gain an observer follows the readings, and its innovations are averaged with the same
    gain: an exponentially weighted chart (Roberts 1959; Lowry et al. 1992) that also sees what
    sensor noise hides from one step to the next. The last run is on its own, under the policy.

    Parameters
    ----------
    dynamics : Dynamics
        The first member is the observers' model.
    predictive_variance : PredictiveVariance
    theta : ndarray, shape (size,)
        The first row.
    act : callable
        The policy, from theta (rows, n_theta) to inputs (rows, m).
    """

    dynamics: Dynamics
    predictive_variance: PredictiveVariance
    theta: Array
    act: Act
    steps: int = field(default=0, init=False)
    cost: float = field(default=0.0, init=False)
    costs: Array = field(init=False)
    charts: Array = field(init=False)
    doubts: Array = field(init=False)

    def __post_init__(self) -> None:
        members, n = len(self.dynamics.members), self.dynamics.problem.model.n_states
        self.rows = np.tile(self.theta, (members, len(GAINS) + 1, 1))
        self.costs = np.zeros(members)
        self.charts, self._gathered, self.doubts = np.zeros((3, len(GAINS), n))

    def step(self, theta: Array, u: Array, after: Array) -> None:
        """Take in one transition of the plant, from row to row."""
        problem, row, rows = self.dynamics.problem, self.dynamics.row, self.rows
        state, followed = row.state, rows[:, :-1, row.state].copy()
        rows[:, -1, row.given] = theta[row.given]
        rows[:, :-1] = theta
        rows[:, :-1, state] = followed
        inputs = np.empty((*rows.shape[:2], len(u)))
        inputs[:] = u
        if np.isfinite(rows[:, -1]).all():  # else the twin ran away, and its costs are not known
            inputs[:, -1] = self.act(row.shown(rows[:, -1]).copy())
            np.clip(
                inputs[:, -1], problem.deviations.u_min, problem.deviations.u_max, out=inputs[:, -1]
            )
        at = np.vstack([rows[:, -1], theta]), np.vstack([inputs[:, -1], u])
        cost = problem.deviations.stage_cost(row.shown(at[0]), at[1])
        self.costs += cost[:-1]
        self.cost += float(cost[-1])
        self.steps += 1
        gains = np.maximum(GAINS, 1.0 / (self.steps + 1))[:, None]  # the first readings count alike
        self.rows = self.dynamics.step(rows, inputs)
        innovations = after[state] - self.rows[:, :-1, state]
        self.innovation = innovations[0, 0]
        self.rows[:, :-1, state] += gains * innovations
        self.charts += GAINS[:, None] * (innovations[0] - self.charts)
        # What is not known passes through the same filters as the innovations.
        self._gathered += self.predictive_variance.doubt(theta, u)
        self.doubts += GAINS[:, None] * (self._gathered - self.doubts)
        self._gathered *= 1.0 - gains


@dataclass(frozen=True)
class ControlLimits:
    """How far charts and costs may go while all is well, from episodes left out of the fit.

    Attributes
    ----------
    predictive_variance : PredictiveVariance
    error : ndarray, shape (n,)
        Root mean squares of one-step errors.
    spread, most : ndarray, shape (gains, n)
        Root mean squares of the charts, and the largest ratios to their scale.
    noisy : ndarray of bool, shape (n,)
        Whether a sensor's errors change from step to step, as noise does.
    repeats : ndarray of int, shape (n,)
        How often in a row a reading repeats itself in the log.
    cost_offset, cost_most : float
        What is added to a predicted cost, and the largest ratio to its scale.
    factor : float
        By how much the largest ratio is exceeded only where something is wrong.
    """

    predictive_variance: PredictiveVariance
    error: Array
    spread: Array
    most: Array
    noisy: NDArray[np.bool_]
    repeats: NDArray[np.int64]
    cost_offset: float
    cost_most: float
    factor: float

    @classmethod
    def of(cls, twin: PlantTwin) -> ControlLimits:
        """Return those of a twin's own log."""
        whole = len(twin.episodes)
        log = [*(twin.episodes if whole >= FEWEST else pieces(twin.episodes, FEWEST))]
        if len(log) < 2:
            raise ValueError(
                "The twin's log is one episode: nothing is left to calibrate a watchdog on. Log "
                "at least one episode more; four are a good number."
            )
        count = min(FOLDS, len(log))
        parts = [(log[k::count], [e for i, e in enumerate(log) if i % count != k])
                 for k in range(count)]  # fmt: skip
        models = _fitted(twin, [kept for _, kept in parts])
        pairs = zip(models, parts, strict=True)
        left = [_one_step(model, e) for model, (out, _) in pairs for e in out]
        error, lag = _errors(left)
        error = np.maximum(error, 1e-9 * twin.dynamics.coordinates.units)
        white = np.minimum((1.0 - lag) / (1.0 + lag), 1.0)
        offset = COST_FLOOR * float(np.mean([costs_of(twin.problem, e) for e in log]))
        found = []
        for model, (out, kept) in zip(models, parts, strict=True):
            known = PredictiveVariance.of(twin, kept, error, white)
            found += [_played(model, known, each, offset) for each in out]
        charts, doubts, ratios = (np.concatenate(each) for each in zip(*found, strict=True))
        spread = np.sqrt(np.mean(charts**2, axis=0)) + 1e-9 * error
        most = np.fmax.reduce(np.abs(charts) / np.hypot(spread, doubts), axis=0)
        return cls(
            predictive_variance=PredictiveVariance.of(twin, log, error, white),
            error=error,
            spread=spread,
            most=np.maximum(most, LEAST_RATIO),
            noisy=lag < NOISY,
            repeats=np.max([_repeats(e.thetas[:, twin.dynamics.row.state]) for e in log], axis=0),
            cost_offset=offset,
            cost_most=max(float(ratios.max()), 1.0),
            factor=FACTOR + FACTOR_OF_FEW / whole,
        )

    def ratios(self, tracks: EwmaCharts) -> Array:
        """Return charts (gains, n) in units of their bands: beyond 1 something is wrong.

        A slow observer of an unstable plant may run away; its charts are left out.
        """
        band = self.factor * self.most * np.hypot(self.spread, tracks.doubts)
        ratios = tracks.charts / band
        return np.where(np.isnan(ratios), 0.0, ratios)

    def cost_ratio(self, tracks: EwmaCharts) -> float:
        """Return by how much the plant has cost more than the twin, in units of the band."""
        return _cost_ratio(tracks, self.cost_offset) / (self.factor * self.cost_most)


def _cost_ratio(tracks: EwmaCharts, offset: float) -> float:
    low, high = float(tracks.costs.min()), float(tracks.costs.max())
    mean = (low + high) / 2
    scale = COST_ERROR * (abs(mean) + offset) + (high - low) / 2
    return (tracks.cost - mean) / scale


def _fitted(twin: PlantTwin, logs: list[list[Episode]]) -> list[Dynamics]:
    """Return the twin with a first member that knows one of the logs only, for each of them."""
    first, *others = twin.dynamics.members
    coordinates = twin.dynamics.coordinates
    if isinstance(first, NetworkResidual):
        made: list[Residual] = [*fit_ensemble(coordinates, logs, seed=0, ahead=AHEAD)]
    else:
        made = [fitted(twin.problem, coordinates, e, [copy.copy(first)])[0] for e in logs]
    return [Dynamics(twin.problem, coordinates, (each, *others)) for each in made]


def _one_step(dynamics: Dynamics, episode: Episode) -> Array:
    """Return one-step errors (T, n) of the first member."""
    first = Dynamics(dynamics.problem, dynamics.coordinates, dynamics.members[:1])
    after = first.step(episode.thetas[None, :-1], episode.actions[None])[0]
    return np.asarray((episode.thetas[1:] - after)[:, dynamics.row.state])


def _errors(left: list[Array]) -> tuple[Array, Array]:
    """Return root mean squares (n,) of errors, and the correlation (n,) of successive ones."""
    squares = np.sum([np.sum(each**2, axis=0) for each in left], axis=0)
    products = np.sum([np.sum(each[1:] * each[:-1], axis=0) for each in left], axis=0)
    lag = np.clip(products / np.maximum(squares, 1e-300), -0.99, 0.999)
    return np.sqrt(squares / sum(map(len, left))), lag


def _played(
    dynamics: Dynamics, predictive_variance: PredictiveVariance, episode: Episode, offset: float
) -> tuple[Array, Array, Array]:
    """Return charts and doubts (T, gains, n) and cost ratios (T,) of a logged episode.

    The run on its own gets the logged inputs, corrected by what the law makes of its deviation.
    """
    law = law_of(dynamics.problem)
    changes = episode.actions - law(dynamics.row.shown(episode.thetas[:-1]))
    tracks = EwmaCharts(dynamics, predictive_variance, episode.thetas[0], law)
    charts, doubts, ratios = [], [], []
    for theta, after, u, change in zip(
        episode.thetas[:-1], episode.thetas[1:], episode.actions, changes, strict=True
    ):
        tracks.act = partial(_corrected, law, change)
        with np.errstate(all="ignore"):
            tracks.step(theta, u, after)
        charts.append(tracks.charts.copy())
        doubts.append(tracks.doubts.copy())
        ratios.append(_cost_ratio(tracks, offset))
    return np.array(charts), np.array(doubts), np.nan_to_num(np.array(ratios), nan=0.0)


def _corrected(law: Act, change: Array, rows: Array) -> Array:
    return law(rows) + change


def _repeats(x: Array) -> NDArray[np.int64]:
    """Return how often in a row, at most, each column repeats its entry."""
    run, longest = np.zeros((2, x.shape[1]), np.int64)
    for same in x[1:] == x[:-1]:
        run = (run + 1) * same
        longest = np.maximum(longest, run)
    return longest
