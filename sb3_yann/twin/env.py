"""Episodes of a twin: where they begin, what is a violation there, and a Gymnasium env of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, Single
from sb3_yann.compare import EXCESS_ROOM
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.mpc.bound_excess import bound_excess
from sb3_yann.twin.dynamics import BEYOND_DATA, Coordinates, Dynamics, Residual, law_of
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann_envs.spaces import ProblemBox

EACH = 5  # episodes, at least, that show by themselves how much they vary
RARE = 0.05  # how likely a start is, in one coordinate, beyond what the log shows


@dataclass(frozen=True)
class Starts:
    """The box of first states, and the logged rows: the first one of each episode, and all.

    The box is that of a uniform distribution, estimated without bias from the first states of the
    log: with k of them it is (k + 1) / (k - 1) times as wide as they are, twice at most.
    """

    row: RowLayout
    low: Array
    high: Array
    first: Array
    rows: Array

    @classmethod
    def of(cls, row: RowLayout, episodes: tuple[Episode, ...]) -> Starts:
        """Return those of a log, whose episodes hold rows of this layout."""
        own = row.problem.deviations
        first = np.array([each.thetas[0] for each in episodes])
        rows = np.concatenate([each.thetas[:-1] for each in episodes])
        n = own.model.n_states
        x = first[:, :n]
        middle = (x.max(0) + x.min(0)) / 2
        half = (x.max(0) - x.min(0)) / 2 * _widened(len(x))
        low = np.maximum(middle - half, own.theta_min[:n])
        high = np.minimum(middle + half, own.theta_max[:n])
        # Where all begin beyond theta's box, they begin there.
        return cls(row, np.minimum(low, high), np.maximum(low, high), first, rows)

    @property
    def shown(self) -> tuple[Array, Array]:
        """The box of theta (n_theta,), twice, that the log shows: all rows, and where it may begin.

        Beyond the latter, in one coordinate, lies one start in twenty: see :meth:`chance_beyond`.
        Fewer than five episodes show no more than five of the same range would: one start in twenty
        beyond two of them lies 25 times as far out, where a fit to two only guesses.
        """
        first = self.row.shown(self.first)
        rows = self.row.shown(self.rows)
        k = max(len(self.first), EACH)
        low = first.min(0)
        high = first.max(0)
        ranges = 2 * (2 / (k + 1) / RARE) ** (1 / (k - 1)) - 1
        further = (high - low) / 2 * max(ranges - 1, 0.0)
        return np.minimum(rows.min(0), low - further), np.maximum(rows.max(0), high + further)

    def draw(self, count: int, rng: np.random.Generator, episodes: Any = None) -> Array:
        """Return rows (count, size) where episodes begin: in the box, the rest as logged.

        Numbers of ``episodes`` (count,) say in which of them; by default they are drawn.
        """
        if episodes is None:
            episodes = rng.integers(len(self.first), size=count)
        drawn = self.first[episodes]
        drawn[:, : len(self.low)] = rng.uniform(self.low, self.high, (count, len(self.low)))
        return self.row.begin(drawn)

    def draw_between(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) where episodes begin, at other set-points as well.

        Every other one has references and disturbances from the box that the log shows: what
        passes at the few of the log may fail between them.
        """
        drawn = self.draw(count, rng)
        if not self.row.problem.layout.has_constants:
            return drawn
        held = self.row.given
        some = drawn[::2].copy()
        own = self.row.problem.deviations
        low, high = np.clip(self.shown, own.theta_min, own.theta_max)
        some[:, held] = rng.uniform(low[held], high[held], some[:, held].shape)
        inside = self.row.problem.law().in_domain(self.row.shown(some))
        drawn[::2][inside] = some[inside]
        return drawn

    def draw_logged(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) from amid the log."""
        return self.rows[rng.integers(len(self.rows), size=count)]

    def draw_around(self, count: int, rng: np.random.Generator) -> Array:
        """Return rows (count, size) from boxes up to three times as wide: nothing is known.

        How wide is drawn evenly, and wider where :meth:`chance_beyond` says so. Those that the law
        has no solution for are replaced by logged ones.
        """
        widest_draw = 3.0  # boxes of starts: as wide others are drawn at most
        drawn = self.draw_between(count, rng)
        own = self.row.problem.deviations
        n = len(self.low)
        k = len(self.first)
        nearest = (1 + _widened(k)) / 2
        ranges = 2 * nearest * rng.uniform(size=(count, 1)) ** (-1 / max(k - 1, 1)) - 1
        wide = np.maximum(ranges / _widened(k), rng.uniform(1, widest_draw, (count, 1)))
        reach = np.minimum(wide, widest_draw) * (self.high - self.low) / 2
        drawn[:, :n] = (self.high + self.low) / 2 + reach * rng.uniform(-1, 1, (count, n))
        shown = np.clip(self.row.shown(drawn), own.theta_min, own.theta_max)
        outside = ~self.row.problem.law().in_domain(shown)
        drawn[:, : shown.shape[1]] = shown
        drawn = self.row.begin(drawn)
        drawn[outside] = self.draw_logged(int(outside.sum()), rng)
        return drawn

    def chance_beyond(self, thetas: Array) -> Array:
        """Return how likely a start lies so far out or farther, in one coordinate: (...,).

        For rows (..., size), in the one that lies farthest out. Of k draws from a uniform
        distribution the next one lies beyond ``rho`` times their range with probability
        ``2 / (k + 1) ((1 + rho) / 2) ** (1 - k)``: spacings are exchangeable.
        """
        n = len(self.low)
        k = len(self.first)
        away = np.abs(thetas[..., :n] - (self.high + self.low) / 2)
        rho = (away / np.maximum(np.ptp(self.first[:, :n], axis=0) / 2, 1e-300)).max(axis=-1)
        return np.asarray(2 / (k + 1) * ((1 + np.maximum(rho, 1.0)) / 2) ** (1.0 - k))


def _widened(k: int) -> float:
    """Return how many times as wide as the range of k starts their box is."""
    # 2.0: times as wide as the log's starts their box is at most
    return min(2.0, (k + 1) / max(k - 1, 1))


PLANNED = 200  # runs of the MPC on its own model that tell where it means to go


@dataclass(frozen=True)
class Limits:
    """A box of states; beyond it is a violation."""

    row: RowLayout
    low: Array
    high: Array

    @classmethod
    def of(cls, coordinates: Coordinates, starts: Starts) -> Limits:
        """Return the data's neighborhood, with the starts, as far as hard bounds let it.

        With set-points or disturbances also that of where the MPC would take its own model: the log
        of a worn plant, which rests beside its set-points, does not show that.
        """
        problem = coordinates.row.problem
        own = problem.deviations
        n = problem.model.n_states
        low = coordinates.low[:n]
        high = coordinates.high[:n]
        boxes = [(starts.low, starts.high)]
        if problem.layout.has_constants:
            model = Dynamics(problem, coordinates, (Residual.zero(len(coordinates.scale), n),))
            first = starts.draw(PLANNED, np.random.default_rng(0))
            steps = len(starts.rows) // len(starts.first)  # as many as the log's episodes have
            rows = model.roll_out(law_of(problem), first[None], steps)[0]
            x = np.clip(rows[..., coordinates.row.state], own.theta_min[:n], own.theta_max[:n])
            boxes.append((x.min(axis=(0, 1, 2)), x.max(axis=(0, 1, 2))))
        for least, most in boxes:
            width = BEYOND_DATA * (most - least)
            low = np.minimum(low, least - width)
            high = np.maximum(high, most + width)
        soft = problem.soft.x > 0
        room = 1e-9 * problem.theta_half[:n]
        low = np.maximum(low, np.where(soft, -np.inf, own.x_min)) - room
        high = np.minimum(high, np.where(soft, np.inf, own.x_max)) + room
        return cls(coordinates.row, low, high)

    def violated(self, thetas: Array, room: float = 0.0) -> NDArray[np.bool_]:
        """Return whether states lie beyond by some half-widths, for rows (..., size); NaN does."""
        x = thetas[..., self.row.state]
        more = room * self.row.problem.theta_half[: len(self.low)]
        return np.asarray(~((x >= self.low - more) & (x <= self.high + more)).all(axis=-1))


@dataclass(frozen=True, eq=False, repr=False)
class LearntModel:
    """Dynamics of a plant, and the episodes, in rows of their layout, that taught them."""

    problem: LinearMPC
    episodes: tuple[Episode, ...]
    dynamics: Dynamics

    @cached_property
    def starts(self) -> Starts:
        """Where episodes begin."""
        return Starts.of(self.dynamics.row, self.episodes)

    @cached_property
    def limits(self) -> Limits:
        """Where it holds, and the problem's own bounds of the states."""
        return Limits.of(self.dynamics.coordinates, self.starts)


class TwinEnv(gym.Env[Single, Single]):
    """Episodes of a member of a twin: theta is observed, the reward is minus the stage cost.

    Theta and inputs are in plant units where the problem's model has an operating point.
    ``info["excess"]`` and ``info["penalty"]`` are those of :class:`~sb3_yann.wrappers.StageCost`.
    ``info["violation"]`` reports an excess, or a state outside what the log shows: there the twin
    knows nothing.

    An episode begins in the box of the log's first states, takes the references and disturbances of
    one of its episodes, and lasts as long. Its seed decides which member acts: seed modulo members.
    :meth:`PlantTwin.env` makes one.
    """

    observation_space: ProblemBox

    def __init__(self, model: LearntModel) -> None:
        self.model = model
        self.dynamics = model.dynamics
        problem = model.problem
        bounds = problem.theta_min, problem.theta_max, problem.u_min, problem.u_max
        low, high, u_min, u_max = (each.astype(np.float32) for each in bounds)
        self.observation_space = ProblemBox(low, high, problem=problem)
        self.action_space = gym.spaces.Box(u_min, u_max)
        self._theta: Array | None = None  # a row

    @property
    def observer(self) -> StateEstimator | None:
        """The observer that is a part of the twin, None where there is none."""
        return self.dynamics.row.estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, from a random theta or ``options["state"]``, (n,) or (n_theta,)."""
        super().reset(seed=seed)
        problem = self.dynamics.problem
        members = self.dynamics.members
        drawn = int(self.np_random.integers(len(members)))
        acting = drawn if seed is None else seed % len(members)
        self._acting = replace(self.dynamics, members=(members[acting],))
        self._episode = self.model.episodes[int(self.np_random.integers(len(self.model.episodes)))]
        row = self.dynamics.row
        first = self._episode.thetas[0].copy()
        theta = row.shown(first)
        state = problem.layout.state
        theta[state] = self.model.starts.draw(1, self.np_random)[0, state]
        if options:
            given = np.asarray(options.get("state"), np.float64)
            sizes = (problem.model.n_states,), (problem.n_theta,)
            if given.shape not in sizes or not np.all(np.isfinite(given)):
                raise ValueError(
                    f"options['state'] = {given.tolist()} must be finite numbers of the shape "
                    f"{sizes[0]} or {sizes[1]}."
                )
            theta[: len(given)] = problem.units.to_deviations(given)
        self._theta = row.begin(first)
        self._steps = 0
        shown = problem.units.to_plant(theta)
        return shown.astype(np.float32), {"state": shown.copy(), "member": acting}

    def step(self, action: Single) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold an input, clipped to its bounds, for one sample."""
        if self._theta is None:
            raise gym.error.ResetNeeded("Call env.reset() before env.step().")
        u = np.asarray(action, np.float64)
        if u.shape != self.action_space.shape or not np.all(np.isfinite(u)):
            raise ValueError(
                f"action = {action!r} must be {self.action_space.shape} finite numbers."
            )
        row = self.dynamics.row
        units = self.dynamics.problem.units
        problem = self.dynamics.problem.deviations
        u = np.clip(units.input_to_deviations(u), problem.u_min, problem.u_max)
        before = self._theta
        after = self._acting.step(before[None, None], u[None, None])[0, 0]
        self._steps += 1
        if self._steps < len(self._episode.thetas):
            after[row.given] = self._episode.thetas[self._steps, row.given]
        self._theta = after
        beyond = bound_excess(problem, row.shown(np.array([before, after])), u[None])
        left = bool(self.model.limits.violated(after, EXCESS_ROOM))
        theta = units.to_plant(row.shown(after))
        cost = float(problem.stage_cost(row.shown(before), u))
        info = {
            "cost": cost,
            "violation": left or bool(beyond.largest > EXCESS_ROOM),
            "excess": float(beyond.largest),
            "penalty": float(beyond.penalty),
            "state": theta,
        }
        return theta.astype(np.float32), -cost, False, self._steps >= len(self._episode), info
