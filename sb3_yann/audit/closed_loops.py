"""Episodes of controllers that remember: those of a plan, of an observer, of another model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.beginnings import beginnings
from sb3_yann.audit.own_reward import as_reward, may_change_reward
from sb3_yann.audit.plants import Plant
from sb3_yann.audit.task import Task
from sb3_yann.audit.trajectory import Plans, Policy, follow, planned
from sb3_yann.compare import less_safe, unsafe_columns
from sb3_yann.control import DisturbanceObserver, LinearMPC
from sb3_yann.control.mpc.bound_excess import BoundExcess, bound_excess
from sb3_yann.evaluation.episodes import Source, as_source, watch_length
from sb3_yann.twin.dynamics import law_of

Controller = Callable[[int, Array, NDArray[np.bool_]], Array]
"""From the step, thetas (k, n_theta) and who still runs (k,) to inputs (k, m)."""
CHANGED = 0.05
"""A reference or disturbance that has moved by so many half-widths is planned for anew."""
PAUSE = 10
"""Steps after a plan for which an estimated disturbance makes no new one."""
DITHER, HELD = 0.1, 5
"""Half-widths by which a log for a twin is excited, and for how many steps each time."""


@dataclass(frozen=True)
class Loops:
    """What came of k episodes that were played side by side.

    Attributes
    ----------
    costs, violations, lengths : ndarray, shape (k,)
        Sums of stage costs, with the penalty of soft bounds; steps in which the env reports a
        violation; steps.
    excess : BoundExcess
        By how much each exceeds the bounds of the problem.
    succeeded : ndarray of bool, shape (k,)
        Whether the last info had ``is_success``.
    thetas, inputs : ndarray, shapes (T + 1, k, n_theta) and (T, k, m)
        After its end an episode stays where it is.
    rewards : ndarray, shape (T, k)
        The env's own; NaN where it reports a violation or terminates, and after the end.
    """

    costs: Array
    violations: NDArray[np.int64]
    lengths: NDArray[np.int64]
    thetas: Array
    inputs: Array
    rewards: Array
    excess: BoundExcess
    succeeded: NDArray[np.bool_]

    def sooner(self, longest: int) -> NDArray[np.int64]:
        """Return by how many steps each is shorter (k,); 0 where its end is a success."""
        return np.where(self.succeeded, 0, np.maximum(longest - self.lengths, 0))

    def no_worse(self, others: Loops) -> NDArray[np.bool_]:
        """Tell which episodes are as long as others, and break no bound by more."""
        longest = int(others.lengths.max(initial=0))
        unsafe = [
            unsafe_columns(
                each.violations, each.sooner(longest), ~np.isfinite(each.costs), each.excess
            )
            for each in (self, others)
        ]
        return np.asarray(~less_safe(unsafe[0], unsafe[1]).any(axis=1))

    def steps(self) -> tuple[Array, Array, Array]:
        """Return thetas, inputs and following thetas of all steps, (steps, ...)."""
        taken = np.arange(len(self.inputs))[:, None] < self.lengths
        return self.thetas[:-1][taken], self.inputs[taken], self.thetas[1:][taken]

    def episodes(self) -> list[tuple[Array, Array]]:
        """Return thetas (T + 1, n_theta) and inputs (T, m) of each episode."""
        return [
            (self.thetas[: length + 1, i], self.inputs[:length, i])
            for i, length in enumerate(self.lengths)
        ]


def maker(env: Source, name: str = "env_or_twin") -> Callable[[], gym.Env[Any, Any]]:
    """Return a function that makes envs like the one that is given, by this name, or made."""
    if isinstance(env, str):
        env = as_source(env)  # "module:function" is a function
    if isinstance(env, str):
        return partial(gym.make, env, disable_env_checker=True)
    if isinstance(env, gym.Env):
        try:
            copy.deepcopy(env)
        except Exception as error:  # whatever a simulator raises that cannot be copied
            raise TypeError(
                f"{name} = {env!r} cannot be copied ({error}). Pass a function that makes "
                "such an env: the starts are played side by side."
            ) from error
        return partial(copy.deepcopy, env)
    if not callable(env):
        raise TypeError(
            f"{name} = {env!r} must be a single gymnasium.Env, its id, a function that makes "
            "one, or a PlantTwin."
        )

    def made() -> gym.Env[Any, Any]:
        found = env()
        if not isinstance(found, gym.Env):
            raise TypeError(f"{name} = {env!r} made {found!r}. It must return a gymnasium.Env.")
        return found

    return made


def play(
    problem: LinearMPC,
    make: Callable[[], gym.Env[Any, Any]],
    seeds: Sequence[int],
    controller: Controller,
) -> Loops:
    """Return one episode for each seed, side by side.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    make : callable
        Makes an env.
    seeds : sequence of int
        Of the k episodes.
    controller : callable
        What acts in all of them.
    """
    with ExitStack() as stack:
        envs = [stack.enter_context(closing(make())) for _ in seeds]
        begun = [env.reset(seed=s)[0] for env, s in zip(envs, seeds, strict=True)]
        now: Array = np.array(begun, dtype=np.float64)
        thetas, running = [now], np.ones(len(envs), dtype=bool)
        inputs: list[Array] = []
        rewards: list[Array] = []
        told: list[NDArray[np.bool_]] = []
        lengths = np.zeros(len(envs), dtype=np.int64)
        succeeded = np.zeros(len(envs), dtype=bool)
        while running.any():
            u = controller(len(inputs), now, running)
            now, violated = now.copy(), np.zeros(len(envs), dtype=bool)
            earned = np.full(len(envs), np.nan)
            for i in np.flatnonzero(running):
                action = u[i].astype(envs[i].action_space.dtype)
                now[i], reward, terminated, truncated, info = envs[i].step(action)
                violated[i] = info.get("violation", False)
                if not (may_change_reward(info) or terminated):
                    earned[i] = as_reward(reward)
                running[i] = not (terminated or truncated)
                lengths[i] += 1
                succeeded[i] = bool(info.get("is_success", False)) and not running[i]
            thetas.append(now)
            inputs.append(u)
            rewards.append(earned)
            told.append(violated)
            watch_length(envs[0], len(inputs))
    states, played = np.array(thetas), np.array(inputs)
    taken = np.arange(len(inputs))[:, None] < lengths
    excess = bound_excess(problem, states, played, taken)
    costs = np.sum(problem.stage_cost(states[:-1], played), axis=0, where=taken) + excess.penalty
    violations = np.sum(np.array(told), axis=0, where=taken)
    paid = np.array(rewards)
    return Loops(costs, violations, lengths, states, played, paid, excess, succeeded)


def require_repeated(
    problem: LinearMPC, make: Callable[[], gym.Env[Any, Any]], seed: int, cost: float
) -> None:
    """Raise unless the MPC's episode from a seed costs the same again.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    make : callable
        Makes an env.
    seed : int
        Of the episode.
    cost : float
        What it cost; what is not finite is not compared.
    """
    again = play(problem, make, [seed], of_law(problem)).costs[0]
    if np.isfinite(cost) and not np.isclose(again, cost, rtol=1e-6, atol=0):
        raise ValueError(
            f"The MPC's episode from the seed {seed} cost {cost:.6g}, then {again:.6g}: the env "
            "does not repeat it. All that is random must come from reset(seed=...). If it draws "
            "from numpy's global generator, wrap it in sb3_yann.wrappers.SeededGlobals."
        )


def of_law(problem: LinearMPC) -> Controller:
    """Return the MPC itself."""
    law = law_of(problem)
    return lambda t, theta, running: np.nan_to_num(law(theta))


def of_model(problem: LinearMPC, other: LinearMPC) -> Controller:
    """Return an MPC with another model and operating point, in the units of the problem."""
    law, layout = other.online(), problem.layout
    u = other.model.u_ss - problem.model.u_ss
    point = np.zeros(problem.n_theta)
    point[layout.state] = other.model.x_ss - problem.model.x_ss
    point[layout.reference] = problem.tracking.C @ point[layout.state]
    point[layout.previous] = u[: layout.n_previous]
    limits = problem.deviations.u_min, problem.deviations.u_max
    return lambda t, theta, running: np.clip(u + law(np.nan_to_num(theta) - point), *limits)


class Excited:
    """The MPC with inputs that are moved at random, each for some steps.

    Parameters
    ----------
    problem : LinearMPC
    seed : int
    """

    def __init__(self, problem: LinearMPC, seed: int) -> None:
        self.problem, self.rng, self.law = problem, np.random.default_rng(seed), of_law(problem)
        self.moved: Array = np.zeros((0, 0))

    def __call__(self, t: int, theta: Array, running: NDArray[np.bool_]) -> Array:
        """Return the inputs (k, m)."""
        problem, shape = self.problem, (len(theta), len(self.problem.R))
        if t % HELD == 0:
            self.moved = DITHER * problem.u_half * self.rng.uniform(-1, 1, shape)
        u = self.law(t, theta, running) + self.moved
        return np.asarray(np.clip(u, problem.deviations.u_min, problem.deviations.u_max))


class Observing:
    """The offset-free MPC, with an observer for each episode.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    other : LinearMPC
        The same with disturbances.
    observer : DisturbanceObserver
        Of all states.
    """

    def __init__(self, problem: LinearMPC, other: LinearMPC, observer: DisturbanceObserver) -> None:
        self.problem, self.other, self.observer = problem, other, observer
        self.observers: list[DisturbanceObserver] = []
        self.u: Array = np.zeros((0, 0))

    def __call__(self, t: int, theta: Array, running: NDArray[np.bool_]) -> Array:
        """Return the inputs (k, m)."""
        layout, bounds = self.problem.layout, self.other.deviations.disturbances
        x = theta[:, layout.state]
        if t == 0:
            self.observers = [copy.copy(self.observer) for _ in x]
            found = [each.reset(y) for each, y in zip(self.observers, x, strict=True)]
        else:
            rows = zip(self.observers, x, self.u, strict=True)
            found = [each.update(y, u) for each, y, u in rows]
        x_hat, d_hat = (np.array(each) for each in zip(*found, strict=True))
        d = np.clip(d_hat, bounds.d_min, bounds.d_max)
        parts = x_hat, theta[:, layout.reference], d, theta[:, layout.previous]
        self.u = np.asarray(self.other.online()(np.concatenate(parts, axis=1)))
        return self.u


class Planning:
    """Plans for the rest of the episode, anew where a reference or disturbance changes.

    Nothing is known of changes before they come. Feedback keeps the plant on its plan.

    Parameters
    ----------
    plant, task : Plant and Task
        What the plans are made with.
    steps : int
        Length of an episode.
    pause : int, default 0
        Steps after a plan for which a disturbance makes no new one: an observer's estimate moves at
        every step until it has settled.

    Attributes
    ----------
    plans : dict of int to (int, Plans)
        The present one of each episode, and the step at which it was made.
    """

    def __init__(self, plant: Plant, task: Task, steps: int, pause: int = 0) -> None:
        self.plant, self.task, self.steps, self.pause = plant, task, steps, pause
        self.plans: dict[int, tuple[int, Plans]] = {}
        self._constants: Array = np.zeros((0, 0))

    def __call__(self, t: int, theta: Array, running: NDArray[np.bool_]) -> Array:
        """Return the inputs (k, m)."""
        problem, constant = self.task.problem, self.task.problem.layout.constant
        if not self.plans:
            self._constants = np.full_like(theta[:, constant], np.nan)
        known = np.isin(np.arange(len(theta)), [*self.plans])
        away = np.abs(theta[:, constant] - self._constants) / problem.theta_half[constant]
        moved, p = (
            ~(away <= CHANGED),
            problem.layout.reference.stop - problem.layout.reference.start,
        )
        for i, (begun, _) in self.plans.items():
            moved[i, p:] &= t >= begun + self.pause
        changed = known & moved.any(axis=1)
        for rows in (running & ~known, running & changed):
            if rows.any() and t < self.steps:
                self._plan(t, theta, np.flatnonzero(rows))
        u = np.zeros((len(theta), problem.model.n_inputs))
        for i, (begun, plan) in self.plans.items():
            at = min(t, self.steps - 1) - begun
            u[i] = np.nan_to_num(follow(plan, at, theta[i : i + 1])[0])
        return np.clip(u, *self.task.limits(theta))

    def _plan(self, t: int, theta: Array, rows: NDArray[np.intp]) -> None:
        problem, left, starts = self.task.problem, self.steps - t, theta[rows]
        law = law_of(problem)
        policies: list[Policy] = [lambda _, at: law(at)]
        if rows[0] not in self.plans:
            policies = beginnings(self.plant, self.task, starts, left, rows)
        found = planned(self.plant, self.task, policies, starts, left, rows)
        for k, row in enumerate(rows):
            self.plans[row] = t, found.of(np.array([k]))
        self._constants[rows] = theta[rows, problem.layout.constant]
