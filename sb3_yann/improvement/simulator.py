"""A simulator that supplies episodes and decides, and the model that is learnt from them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_yann._progress import shown
from sb3_yann._validation import Array, NonFiniteWarning, warn
from sb3_yann.audit.meaning import (
    SIGN_STARTS,
    SIGN_STEPS,
    require_spaces,
    require_theta_shown,
    warn_of_box,
    warn_of_order,
    warn_of_own_reward,
    warn_of_signs,
)
from sb3_yann.compare import NewSeeds, unsafe_columns
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.mpc.bound_excess import costs_of
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import ProcessEndedError, Source, maker, name_of, observer_of, pool_of
from sb3_yann.plan import WEIGHT, Disagreement, Task, TwinPlant, value_at_end
from sb3_yann.rollout import (
    Controller,
    Rows,
    Trajectories,
    joined,
    of_episode,
    require_repeated,
    rollout,
)
from sb3_yann.twin.dynamics import Coordinates, Dynamics, law_of, play
from sb3_yann.twin.env import LearntModel
from sb3_yann.twin.log import SHORTEST, Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import fit_ensemble, fit_family
from sb3_yann.units import ActionUnits, Units
from sb3_yann.wrappers.theta import SetPoint, below, require_vector

FIRST = 3_000_000  # seed of the first episode: far from those that people try first
EPISODES = 20  # of the MPC, with and without random inputs, that the first model is fitted to


Map = Callable[[Array], Array]  # from an observation to theta


def _in_deviations(
    make: Callable[[], gym.Env[Any, Any]], units: Units, observation: Map | None
) -> gym.Env[Any, Any]:
    """Return an env in plant units as laws compute with it: see :func:`in_deviations`."""
    env = make()
    seen: Any = env.observation_space
    taken: Any = env.action_space
    far = np.full(len(units.theta_ss), np.inf)
    low, high = (seen.low, seen.high) if observation is None else (-far, far)

    def theta(shown: Any) -> Array:
        return units.to_deviations(shown if observation is None else observation(np.ravel(shown)))

    def action(u: Any) -> Any:
        # Rounding must not leave the space of the env.
        return np.clip(units.input_to_plant(u), taken.low, taken.high).astype(taken.dtype)

    seen = spaces.Box(low - units.theta_ss, high - units.theta_ss, dtype=np.float64)
    inputs = spaces.Box(taken.low - units.u_ss, taken.high - units.u_ss, dtype=np.float64)
    env = gym.wrappers.TransformObservation(env, theta, seen)
    return gym.wrappers.TransformAction(env, action, inputs)


def in_deviations(
    make: Callable[[], gym.Env[Any, Any]], problem: LinearMPC, observation: Map | None = None
) -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes envs that show theta, and take inputs, in deviations.

    ``observation`` makes theta in plant units of what the env shows; by default it shows that.
    Actions in other units are a ValueError.
    """
    with closing(make()) as env:
        space = require_vector(env, "action_space")
        require_state_shown(env, observation is not None)
        if observation is None:
            require_spaces(problem, env)
    units = ActionUnits.of(problem, space.low, space.high)
    if units is not None and units.kind == "normalized":
        raise ValueError(
            f"The env takes normalized inputs, from {space.low.tolist()} to {space.high.tolist()}, "
            f"and the MPC inputs from {problem.u_min.tolist()} to {problem.u_max.tolist()}. Wrap "
            "it in gymnasium.wrappers.RescaleAction(env, mpc.u_min, mpc.u_max)."
        )
    own = problem.deviations
    if units is None and own is not problem and ActionUnits.of(own, space.low, space.high):
        raise ValueError(
            f"The env takes deviations, from {space.low.tolist()} to {space.high.tolist()}, and "
            f"the MPC is in plant units, from {problem.u_min.tolist()} to {problem.u_max.tolist()}."
            " Leave x_ss and u_ss out of its model, or take the env in plant units."
        )
    if observation is None and not problem.units.shifted:
        return make
    return partial(_in_deviations, make, problem.units, observation)


class OutOfStepsError(Exception):
    """The simulator would take more steps than it may."""


@dataclass
class _Count:
    """Steps, of which there may be no more than so many; ``strict`` envs may not fail in one."""

    most: float
    strict: bool = True
    steps: int = 0


class _Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Counts each step before it is taken; OutOfStepsError where none is left."""

    def __init__(self, env: gym.Env[Any, Any], count: _Count) -> None:
        super().__init__(env)
        self.count = count

    def step(self, action: Any) -> Any:
        """Step the env; where it fails off the MPC's ways, the episode ends with NaN."""
        if self.count.steps >= self.count.most:
            raise OutOfStepsError
        self.count.steps += 1
        try:
            return self.env.step(action)
        except Exception as error:  # whatever it raises in a state that it cannot be in
            if self.count.strict or isinstance(error, ProcessEndedError):
                raise
            warn(
                f"The simulator raised {error!r}: what leads there ends there, and counts as lost. "
                "The MPC's own episodes do not.",
                NonFiniteWarning,
            )
            space: Any = self.env.observation_space
            return np.full(space.shape, np.nan), np.nan, True, False, {}


def _play_there(
    controller: Controller,
    make: Callable[[], gym.Env[Any, Any]],
    seeds: Sequence[int],
    problem: LinearMPC,
    count: _Count,
) -> tuple[Trajectories | None, int]:
    """Return episodes, None where steps do not suffice, and how many were taken, from a worker."""
    played = None
    with shown(False), suppress(OutOfStepsError):  # many bars would write over each other
        played = rollout(controller, lambda: _Counted(make(), count), seeds, problem=problem)
    return played, count.steps


class Simulator:
    """Episodes of a simulator of a problem's plant; none before :meth:`begin`.

    It takes the problem's inputs in plant units, and ``observation`` makes theta of what it shows;
    by default it shows that. What is known of it is in ``episodes``, rows of the layout ``row``;
    ``played`` of them took so many ``seconds``. While it ``shares`` a lot with workers, their steps
    are not counted yet.
    """

    def __init__(
        self,
        problem: LinearMPC,
        env: Source | VecEnv,
        seed: int,
        max_steps: int | None = None,
        observation: Callable[[Array], Array] | None = None,
    ) -> None:
        self.problem = problem
        self.seed = seed
        self.max_steps = max_steps
        self.played = 0
        self.seconds = 0.0
        self.counted = _Count(np.inf if max_steps is None else max_steps)
        self.make = in_deviations(maker(env, "twin"), problem, observation)
        self.envs = pool_of(env, lambda: _Counted(self.make(), self.counted))
        with self.envs.acquire(1) as (one,):
            self.row = RowLayout(problem, observer_of(one))
            self.unaware = below(one, SetPoint) is not None  # its reward, of set-points
            require_spaces(problem, one)
            self.name = name_of(one if callable(env) else env)
        self.new_seeds = NewSeeds(FIRST + 1_000_000 * seed)
        self.longest = 0
        self.episodes: list[Episode] = []
        self.shares = False

    def begin(self, later: int = 0) -> None:
        """Play the first episodes, of the MPC with and without random inputs; check the env.

        OutOfStepsError after one, where so many ``later`` ones of its length are too many steps.
        """
        seeds = self.new_seeds(1)
        played = self.play(of_law(self.problem), seeds)
        if self.needed(later) > self.counted.most:
            self._warn(played, seeds)
            raise OutOfStepsError
        self.learn(played, seeds)
        each = self.usual // 2
        seeds = self.new_seeds(each - 1)
        self.learn(self.watch(seeds), seeds)
        self.excite(each)
        self.require_episodes()

    def require_episodes(self) -> None:
        """Raise ValueError where no episode so far is of use."""
        if not self.episodes:
            raise ValueError(
                f"None of {self.played} episodes of the MPC in the simulator begins with "
                f"{SHORTEST} steps whose readings are finite, and at most its width beyond theta's "
                "box: there is nothing to learn from."
            )

    @property
    def usual(self) -> int:
        """How many episodes a first model is fitted to."""
        count = EPISODES
        # 3,000 steps at least, of at most sixty episodes.
        while count < 60 and count * self.longest < 3_000:
            count += EPISODES // 2
        return count

    def needed(self, later: int) -> int:
        """Return how many steps the first episodes and so many later ones take; 0: not known."""
        m = self.problem.model.n_inputs
        pushes = m if self.row.estimator is None else SIGN_STEPS * (m + 1)
        return self.longest * (self.usual + 1 + later) + SIGN_STARTS * pushes * (self.longest > 0)

    @property
    def steps(self) -> int:
        """How many it has taken."""
        return self.counted.steps

    def watch(self, seeds: Sequence[int], checked: bool = True) -> Trajectories:
        """Return episodes of the MPC; see that the env repeats them, and shows the problem's theta.

        Warn where it means something else by it, acts the other way, or has its own reward.
        """
        problem = self.problem
        played = self.play(of_law(problem), seeds)
        starts = np.array([each[0] for each, _ in played.pairs])
        require_theta_shown(problem, played.steps()[0], starts)
        again = rollout(of_law(problem), self.envs, seeds[:1], problem=problem)
        require_repeated("the env", seeds[0], played.costs[0], again.costs[0])
        if not checked:
            return played
        self._warn(played, seeds)
        warn_of_box(problem, starts)
        if not self.unaware:
            warn_of_own_reward(problem, played)
        return played

    def _warn(self, played: Trajectories, seeds: Sequence[int]) -> None:
        """Warn where states or inputs mean something else than in the problem."""
        warn_of_order(self.problem, *played.steps())
        with self.envs.acquire(1) as (one,):
            warn_of_signs(self.problem, one, seeds, played)

    def excite(self, count: int) -> None:
        """Learn from so many episodes of the MPC with random inputs on top, from new starts.

        Where only an estimator's memory stands for the plant's state they are from known starts:
        episodes of one seed differ by their inputs alone, whatever loads it brings.
        """
        known = [each.seed for each in self.episodes if each.seed is not None]
        seeds = known[:count] if self.row.is_estimate else self.new_seeds(count)
        self.learn(self.play(Excited(self.problem, self.seed), seeds, strict=False), seeds)

    def affordable(self) -> int:
        """Return how many episodes the steps that are left surely suffice for."""
        left = min(self.counted.most - self.counted.steps, sys.maxsize)
        return int(left) // max(self.longest, 1)

    def play(
        self, controller: Controller, seeds: Sequence[int], strict: bool = True
    ) -> Trajectories:
        """Return episodes; OutOfStepsError where they might take more steps than are left.

        Within ``joblib.parallel_config(backend, n_jobs=...)`` its workers play them, unless the
        controller ``remembers``. Unless it is ``strict``, an episode in which the env fails ends
        there.
        """
        counted = self.counted
        problem = self.problem
        left = counted.most - counted.steps
        if len(seeds) > self.affordable():
            raise OutOfStepsError
        begun = time.monotonic()
        joblib: Any = sys.modules.get("joblib")
        alone = joblib is None or self.envs.most or getattr(controller, "remembers", False)
        jobs = 1 if alone else min(joblib.effective_n_jobs(None), len(seeds))
        if jobs > 1:
            parts = np.array_split(np.arange(len(seeds)), jobs)
            tasks = [
                partial(
                    _play_there,
                    of_episode(controller, int(part[0])),
                    self.make,
                    [seeds[i] for i in part],
                    problem,
                    _Count(np.floor(left * len(part) / len(seeds)), strict),
                )
                for part in parts
            ]
            self.shares = True
            # Workers of "multiprocessing" are sent nothing else that holds a lambda.
            sent = map(joblib.wrap_non_picklable_objects, tasks)
            found = joblib.Parallel()(joblib.delayed(each)() for each in sent)
            self.shares = False
            counted.steps += sum(steps for _, steps in found)
            complete = [part for part, _ in found if part is not None]
            if len(complete) < jobs:
                raise OutOfStepsError
            played = joined(complete)
        else:
            counted.strict = strict
            played = rollout(controller, self.envs, seeds, problem=problem)
            counted.strict = True
        self.seconds += time.monotonic() - begun
        self.played += len(seeds)
        self.longest = max(self.longest, int(played.lengths.max(initial=0)))
        return played

    def learn(self, played: Trajectories, seeds: Sequence[int]) -> list[Episode | None]:
        """Take the first parts of episodes that are of use, and return them; None for none.

        Thetas are finite there, and states at most a width beyond the box: an env that has failed
        shows others, and so do equations beyond where they hold.
        """
        found: list[Episode | None] = []
        part = self.problem.layout.state
        low = self.problem.deviations.theta_min[part]
        high = self.problem.deviations.theta_max[part]
        for (thetas, inputs), seed in zip(played.pairs, seeds, strict=True):
            x = thetas[:, part]
            near = (x >= low - (high - low)) & (x <= high + (high - low))
            usual = near.all(axis=1) & np.isfinite(thetas).all(axis=1)
            kept = int(np.argmin(np.append(usual, False)))
            thetas = thetas[:kept]
            inputs = inputs[: max(kept - 1, 0)]
            usable = len(inputs) >= SHORTEST and bool(np.isfinite(inputs).all())
            found.append(Episode(*self.row.recovered(thetas, inputs), seed) if usable else None)
        self.episodes += [each for each in found if each is not None]
        return found

    def close(self) -> None:
        """Close all envs."""
        self.envs.close()


def of_law(problem: LinearMPC) -> Controller:
    """Return the MPC itself."""
    law = law_of(problem)
    return lambda t, theta, rows: np.nan_to_num(law(theta))


@dataclass
class Excited:
    """The MPC with inputs that are moved by ``push`` half-widths at most, each for some steps."""

    problem: LinearMPC
    seed: int
    push: float = 0.5  # half-widths by which inputs are moved at random, at most

    def __post_init__(self) -> None:
        self.law = of_law(self.problem)

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m): those of an episode do not depend on what others there are."""
        problem = self.problem
        every = (int(rows.max(initial=-1)) + 1, problem.model.n_inputs)
        # Every five steps inputs move anew, for 70 % of the time.
        moves, times = (np.random.default_rng([self.seed, t // 5, i]) for i in range(2))
        moved = self.push * problem.u_half * moves.uniform(-1, 1, every)
        moved *= times.random((len(moved), 1)) < 0.7
        u = self.law(t, theta, rows) + moved[rows]
        return np.asarray(np.clip(u, problem.deviations.u_min, problem.deviations.u_max))


def one_step_error(row: RowLayout, episodes: Sequence[Episode]) -> float:
    """Return how far the given model errs in 95 % of the steps at most, in half-widths of theta.

    It is what the inputs that keep the problem's bounds are computed with.
    """
    half = row.problem.theta_half[row.problem.layout.state]
    errors = []
    for each in episodes:
        predicted = np.hstack([each.thetas[:-1], each.actions]) @ row.linear[row.state].T
        errors.append(np.max(np.abs(each.thetas[1:, row.state] - predicted) / half, axis=1))
    return float(np.nanquantile(np.concatenate(errors), 0.95))


def model_of(
    problem: LinearMPC, episodes: Sequence[Episode], observer: StateEstimator | None, seed: int
) -> LearntModel:
    """Return networks on top of the given model, fitted to episodes in the observer's rows."""
    coordinates = Coordinates.of(RowLayout(problem, observer), episodes)
    # Two networks: a simulator repeats its steps.
    members = fit_ensemble(coordinates, [episodes] * 2, seed)
    return LearntModel(problem, tuple(episodes), Dynamics(problem, coordinates, tuple(members)))


class Family(LearntModel):
    """A model whose members differ by constants that no reading shows, such as a feed's strength.

    There is one member for each seed of its episodes.
    """

    @classmethod
    def of(cls, model: LearntModel, seed: int) -> LearntModel:
        """Return a family of a model's episodes if it explains them clearly better, else the model.

        Behind an estimator a load that lasts is no reason: what was missed of an episode comes
        again in each scenario.
        """
        if lacks(model) != (True, False):
            return model
        coordinates = model.dynamics.coordinates
        episodes = model.episodes
        members = tuple(fit_family(coordinates, episodes, seed))
        found = cls(model.problem, episodes, Dynamics(model.problem, coordinates, members))
        before = [missed_of(model, each) for each in episodes]
        left = sum(np.sum(((each - each.mean(axis=0)) / coordinates.units) ** 2) for each in before)
        now = sum(np.sum((missed_of(found, each) / coordinates.units) ** 2) for each in episodes)
        # 0.03: share of the errors' squares that hidden constants leave, at most
        return found if now <= 0.03 * left else model

    def member_of(self, episode: Episode) -> int:
        """Return the number of the member that predicts an episode best."""
        errors = _missed(self, episode, slice(None)) / self.dynamics.coordinates.units
        return int(np.argmin(np.mean(errors**2, axis=(1, 2))))


def missed_of(model: LearntModel, episode: Episode) -> Array:
    """Return what a model misses of the states after each step of an episode, (T, n)."""
    return _missed(model, episode, model.member_of(episode) if isinstance(model, Family) else None)


def _missed(model: LearntModel, episode: Episode, member: int | slice | None) -> Array:
    """Return the same of one member, of each (members, T, n), or of the mean of all."""
    part = model.dynamics.row.state
    after = episode.thetas[1:, part]
    steps = model.dynamics.step(episode.thetas[None, :-1], episode.actions[None])[..., part]
    predicted = steps.mean(axis=0) if member is None else steps[member]
    return np.asarray(after - model.dynamics.coordinates.nearest(predicted, after))


def lacks(model: LearntModel) -> tuple[bool, bool]:
    """Return whether a model errs in most steps, and whether that is more than noise.

    Kinks of a plant show in few. Noise of a step says nothing about that of the nearest one, half
    of whose squared difference is its variance. What a model lacks is alike in both.
    """
    from scipy.spatial import cKDTree

    episodes = model.episodes
    row = model.dynamics.row
    errors = np.concatenate([missed_of(model, each) for each in episodes])
    errors /= model.dynamics.coordinates.units
    points = np.concatenate([row.features(each.thetas[:-1], each.actions) for each in episodes])
    points = points / np.maximum(points.std(axis=0), 1e-9)
    other = cKDTree(points).query(points, k=2)[1][:, 1]
    apart = np.mean((errors - errors[other]) ** 2) / 2
    # 0.01: standard deviations of the states: what errs less in most steps has no noise
    errs = bool(np.median(np.abs(errors), axis=0).max() > 0.01)
    # 0.5: share of the errors of neighboring steps that is not alike: more is noise
    return errs, errs and bool(apart < 0.5 * np.mean(errors**2))


def task_of(model: LearntModel, unit: float, priced: bool = True) -> Task:
    """Return what plans in a model are to minimize; ``unit`` is a typical cost of a step.

    Where it is ``priced``, the members' disagreement costs as well; with an observer it does not.
    """
    doubt = None
    if priced and model.dynamics.row.observer is None:
        # 10.0: mean costs of a step for members that differ by a standard deviation of a state
        doubt = Disagreement(model.dynamics, 10.0 * unit)
    end = value_at_end(model.problem)
    limits = model.limits
    return Task(model.problem, limits.low, limits.high, end.P, WEIGHT * unit, doubt, end.slope)


@dataclass(frozen=True, eq=False)
class Imagined:
    """Episodes that were played in a model, side by side.

    ``rows`` (T + 1, k, size), ``thetas`` (T + 1, k, n_theta), ``inputs`` (T, k, m), ``costs`` (k,)
    with the penalty of soft bounds, and ``unsafe`` (k, 9) of
    :func:`~sb3_yann.compare.unsafe_columns`.
    """

    rows: Array
    thetas: Array
    inputs: Array
    costs: Array
    unsafe: Array

    def of(self, chosen: NDArray[np.intp]) -> Imagined:
        """Return some of them."""
        rows, thetas, inputs = (a[:, chosen] for a in (self.rows, self.thetas, self.inputs))
        return Imagined(rows, thetas, inputs, self.costs[chosen], self.unsafe[chosen])


@dataclass(frozen=True, eq=False)
class Scenarios:
    """Starts (k, size), and references and measured disturbances ``given`` (T, k, p) after them.

    ``members`` (k,) act in them, by default their mean. What they ``missed`` (T, k, n) of an
    episode, loads and noise that nothing measures, comes again.
    """

    model: LearntModel
    members: NDArray[np.intp] | None
    starts: Array
    given: Array
    missed: Array | None = None

    @classmethod
    def like(
        cls,
        model: LearntModel,
        episodes: Sequence[Episode],
        rng: np.random.Generator | None = None,
        midway: int = 0,
    ) -> Scenarios:
        """Return scenarios like some episodes, with their references and disturbances.

        They begin as their episodes did. With ``rng`` every other one begins in the box of all
        first states, and the last ``midway`` ones where their episode had got to.
        """
        row = model.dynamics.row
        steps = max(map(len, episodes))
        n = model.problem.model.n_states
        first = np.zeros(len(episodes), dtype=np.int64)
        usual = len(first) - midway
        if rng is not None:
            first[usual:] = rng.integers([len(each) for each in episodes[usual:]])
        begun = [*zip(episodes, first, strict=True)]
        thetas = row.shown(np.array([e.thetas[t] for e, t in begun]))
        if rng is not None:
            moved = thetas[1:usual:2, :n]
            moved[:] = rng.uniform(model.starts.low, model.starts.high, moved.shape)
        given = [e.thetas[np.minimum(t + np.arange(steps), len(e))][:, row.given] for e, t in begun]
        once = {id(each): each for each in episodes}
        members = missed = None
        if isinstance(model, Family):
            number = {key: model.member_of(each) for key, each in once.items()}
            members = np.array([number[id(each)] for each in episodes])
        if row.estimator is not None:
            of_each = {key: missed_of(model, each) for key, each in once.items()}
            missed = np.zeros((steps, len(episodes), n))
            for i, (e, t) in enumerate(begun):
                missed[: len(e) - t, i] = of_each[id(e)][t:]
        return cls(model, members, row.begin(thetas), np.stack(given, axis=1), missed)

    @cached_property
    def plant(self) -> TwinPlant:
        """What acts in them."""
        return TwinPlant(self.model.dynamics, self.members)

    def of(self, chosen: NDArray[np.intp]) -> Scenarios:
        """Return some of them."""
        members = None if self.members is None else self.members[chosen]
        missed = None if self.missed is None else self.missed[:, chosen]
        return Scenarios(self.model, members, self.starts[chosen], self.given[:, chosen], missed)

    def later(self, rows: Array, steps: NDArray[np.int64]) -> Scenarios:
        """Return scenarios that begin at some steps (k,) of episodes of rows (T + 1, k, size)."""
        every = np.arange(len(self))
        at = np.arange(len(self.given))[:, None] + steps
        over = at >= len(at)
        at[over] = len(at) - 1
        given = self.given[at, every]
        missed = self.missed
        if missed is not None:
            missed = np.where(over[..., None], 0.0, missed[at, every])
        return replace(self, starts=rows[steps, every], given=given, missed=missed)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.starts)

    def play(self, controller: Controller) -> Imagined:
        """Return the episodes of a controller."""
        problem = self.model.problem
        row = self.model.dynamics.row
        numbers = np.arange(len(self))
        limits = problem.deviations.u_min, problem.deviations.u_max

        def act(t: int, rows: Array) -> Array:
            return np.clip(np.nan_to_num(controller(t, row.shown(rows), numbers)), *limits)

        def step(t: int, rows: Array, inputs: Array) -> Array:
            after = self.plant.advance(rows[t], inputs[t], numbers)
            if self.missed is not None:
                after += self.missed[t] @ row.spread.T
                row.clip(after)
            return after

        with np.errstate(all="ignore"):
            size = len(self.given), problem.model.n_inputs
            rows, inputs = play(act, step, self.starts, *size, (row.given, self.given))
            thetas = row.shown(rows)
            costs, excess = costs_of(problem, thetas, inputs)
        lost = ~(np.isfinite(costs) & np.isfinite(thetas).all(axis=(0, 2)))
        costs = np.where(lost, np.inf, costs)
        return Imagined(rows, thetas, inputs, costs, unsafe_columns(0, 0, lost, excess))
