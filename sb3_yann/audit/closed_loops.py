"""Episodes of controllers that remember: those of a plan, of an observer, of another model."""

from __future__ import annotations

import copy

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.initial_guesses import initial_guesses
from sb3_yann.audit.plants import Plant
from sb3_yann.audit.task import Task
from sb3_yann.audit.trajectory import Plans, Policy, follow, planned
from sb3_yann.control import DisturbanceObserver, LinearMPC
from sb3_yann.rollout import Controller, EnvPool, Rows, Source, rollout
from sb3_yann.twin.dynamics import law_of

CHANGED = 0.05
"""A reference or disturbance that has moved by so many half-widths is planned for anew."""
PAUSE = 10
"""Steps after a plan for which an estimated disturbance makes no new one."""
DITHER, HELD = 0.1, 5
"""Half-widths by which a log for a twin is excited, and for how many steps each time."""


def require_repeated(problem: LinearMPC, env: Source | EnvPool, seed: int, cost: float) -> None:
    """Raise unless the MPC's episode from a seed costs the same again.

    Parameters
    ----------
    problem : LinearMPC
        Whose theta the env shows.
    env : gymnasium.Env, str, callable or EnvPool
        It plays the episode.
    seed : int
        Of the episode.
    cost : float
        What it cost; what is not finite is not compared.
    """
    again = rollout(of_law(problem), env, [seed], problem=problem).costs[0]
    if np.isfinite(cost) and not np.isclose(again, cost, rtol=1e-6, atol=0):
        raise ValueError(
            f"The MPC's episode from the seed {seed} cost {cost:.6g}, then {again:.6g}: the env "
            "does not repeat it. All that is random must come from reset(seed=...). If it draws "
            "from numpy's global generator, wrap it in sb3_yann.wrappers.SeededGlobals."
        )


def of_law(problem: LinearMPC) -> Controller:
    """Return the MPC itself."""
    law = law_of(problem)
    return lambda t, theta, rows: np.nan_to_num(law(theta))


def of_model(problem: LinearMPC, other: LinearMPC) -> Controller:
    """Return an MPC with another model and operating point, as a law of the problem's theta."""
    law, own, its = other.online(), problem.units, other.units
    limits = problem.deviations.u_min, problem.deviations.u_max

    def act(t: int, theta: Array, rows: Rows) -> Array:
        u = law(its.to_deviations(own.to_plant(np.nan_to_num(theta))))
        return np.clip(own.input_to_deviations(its.input_to_plant(u)), *limits)

    return act


class Excited:
    """The MPC with inputs that are moved at random, each for some steps.

    Parameters
    ----------
    problem : LinearMPC
    seed : int
    push : float, default 0.1
        Half-widths by which they are moved at most.
    often : float, default 1
        Share of the time in which they are.
    """

    def __init__(
        self, problem: LinearMPC, seed: int, push: float = DITHER, often: float = 1.0
    ) -> None:
        self.problem, self.rng, self.law = problem, np.random.default_rng(seed), of_law(problem)
        self.push, self.often = push, often
        self.moved: Array = np.zeros((0, 0))

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        problem = self.problem
        if t == 0:
            self.moved = np.zeros((len(rows), problem.model.n_inputs))
        if t % HELD == 0:  # one draw for each episode, also for those that are over
            self.moved = self.push * problem.u_half * self.rng.uniform(-1, 1, self.moved.shape)
            if self.often < 1:
                self.moved *= self.rng.random((len(self.moved), 1)) < self.often
        u = self.law(t, theta, rows) + self.moved[rows]
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

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        layout, bounds = self.problem.layout, self.other.deviations.disturbances
        x = theta[:, layout.state]
        if t == 0:
            self.observers = [copy.copy(self.observer) for _ in x]
            self.u = np.zeros((len(x), self.other.model.n_inputs))
            found = [each.reset(y) for each, y in zip(self.observers, x, strict=True)]
        else:
            pairs = zip(rows, x, strict=True)
            found = [self.observers[i].update(y, self.u[i]) for i, y in pairs]
        x_hat, d_hat = (np.array(each) for each in zip(*found, strict=True))
        d = np.clip(d_hat, bounds.d_min, bounds.d_max)
        parts = x_hat, theta[:, layout.reference], d, theta[:, layout.previous]
        self.u[rows] = self.other.online()(np.concatenate(parts, axis=1))
        return self.u[rows]


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
    plans : dict of int to (int, Plans, ndarray)
        The present one of each episode, the step at which it was made, and the reference and
        disturbance of then.
    """

    def __init__(self, plant: Plant, task: Task, steps: int, pause: int = 0) -> None:
        self.plant, self.task, self.steps, self.pause = plant, task, steps, pause
        self.plans: dict[int, tuple[int, Plans, Array]] = {}

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        problem, constant = self.task.problem, self.task.problem.layout.constant
        known = np.isin(rows, [*self.plans])
        changed = np.zeros(len(rows), dtype=bool)
        for k in np.flatnonzero(known):
            planned_at, _, constants = self.plans[rows[k]]
            away = np.abs(theta[k, constant] - constants) / problem.theta_half[constant]
            moved = ~(away <= CHANGED)
            if t < planned_at + self.pause:  # an estimated disturbance may still settle
                moved[problem.layout.reference.stop - problem.layout.reference.start :] = False
            changed[k] = moved.any()
        for chosen in (~known, changed):
            if chosen.any() and t < self.steps:
                self._plan(t, theta[chosen], rows[chosen])
        u = np.zeros((len(rows), problem.model.n_inputs))
        for k, row in enumerate(rows):
            if row in self.plans:
                planned_at, plan, _ = self.plans[row]
                at = min(t, self.steps - 1) - planned_at
                u[k] = np.nan_to_num(follow(plan, at, theta[k : k + 1])[0])
        return np.clip(u, *self.task.limits(theta))

    def _plan(self, t: int, starts: Array, rows: Rows) -> None:
        problem, left = self.task.problem, self.steps - t
        law = law_of(problem)
        policies: list[Policy] = [lambda _, at: law(at)]
        if rows[0] not in self.plans:
            policies = initial_guesses(self.plant, self.task, starts, left, rows)
        found = planned(self.plant, self.task, policies, starts, left, rows)
        for k, row in enumerate(rows):
            constants = starts[k, problem.layout.constant].copy()
            self.plans[row] = t, found.of(np.array([k])), constants
