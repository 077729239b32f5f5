"""The planner: nearly optimal trajectories of many starts at once, and feedback that keeps them.

Control-limited differential dynamic programming with Gauss-Newton curvature (Y. Tassa, N. Mansard
and E. Todorov, ICRA 2014). A bound of several inputs that is met once stays active in its step.
Plans are made in the members of a model; :class:`Planning` plays them on a plant.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sb3_yann._progress import bar
from sb3_yann._validation import Array, Feedback, Mask
from sb3_yann.control import LinearMPC, lqr
from sb3_yann.control.mpc.bound_excess import Bounds, mixed_beyond, mixed_half
from sb3_yann.control.mpc.problem import Value
from sb3_yann.rollout import Rows
from sb3_yann.twin.dynamics import Dynamics, law_of, play

Policy = Callable[[int, Array], Array]  # step and thetas (k, n_theta) -> inputs (k, m)

SIZES = (1.0, 0.5, 0.2, 0.05)  # parts of a correction that are tried, the first first
SETTLED = 1e-5  # A start is done when a correction saves less than this part of its cost
INSIDE = 1e-3
WEIGHT = 1e4
"""How far inside of the bounds plans stay, in half-widths; what one half-width beyond that costs in
a step, in mean costs of a step."""
WEIGHTS = 0.1, 10.0  # factors of weights of the MPC, for laws that are tried instead of it
PAUSE = 10  # steps after a plan for which an estimated disturbance makes no new one


class TwinPlant:
    """The members of a twin, one for each start, or by default the mean of all.

    ``turn`` is a full turn for each entry of theta that is an angle and jumps; None where none is.
    """

    def __init__(self, dynamics: Dynamics, members: Iterable[int] | None = None) -> None:
        self.dynamics = dynamics
        self.members = None if members is None else [*members]
        self._known: dict[bytes, Dynamics] = {}
        turn = dynamics.coordinates.turn
        others = dynamics.problem.n_theta - dynamics.problem.model.n_states
        self.turn = None if turn is None else np.append(turn, np.zeros(others))

    def _acting(self, rows: Rows) -> Dynamics:
        if self.members is None:
            return self.dynamics
        key = rows.tobytes()
        if key not in self._known:
            if len(self._known) == 16:  # sets of starts: networks take memory
                self._known.clear()
            chosen = tuple(self.dynamics.members[self.members[row]] for row in rows)
            self._known[key] = dataclasses.replace(self.dynamics, members=chosen)
        return self._known[key]

    def advance(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next rows of the twin (k, size), with what an observer remembers."""
        acting = self._acting(rows)
        if self.members is not None:
            return np.asarray(acting.step(theta[:, None], u[:, None])[:, 0])
        return np.asarray(acting.step(theta[None], u[None]).mean(axis=0))

    def step(self, theta: Array, u: Array, rows: Rows) -> Array:
        """Return the next theta (k, n_theta), of the starts ``rows``; an estimated d stays."""
        row = self.dynamics.row
        after = self.advance(row.begin(theta), u, rows)
        found = row.shown(after).copy()
        parts = self.dynamics.problem.layout
        if row.observer is not None:
            found[:, parts.state] = after[:, row.state]
            found[:, parts.disturbance] = theta[:, parts.disturbance]
        return found

    def slopes(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives of rows at theta (T, k, size) and u (T, k, m)."""
        acting = self._acting(rows)
        steps = theta.shape[:2]
        if self.members is not None:
            both = acting.jacobians(theta.swapaxes(0, 1), u.swapaxes(0, 1))
            A, B = (each.swapaxes(0, 1) for each in both)
            return A, B
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (theta, u))
        means = (each.mean(axis=0) for each in acting.jacobians(*flat))
        A, B = (each.reshape(*steps, *each.shape[1:]) for each in means)
        return A, B

    def jacobians(self, theta: Array, u: Array, rows: Rows) -> tuple[Array, Array]:
        """Return the derivatives, (T, k, n_theta, n_theta) and (T, k, n_theta, m)."""
        row = self.dynamics.row
        parts = self.dynamics.problem.layout
        A, B = self.slopes(row.begin(theta), u, rows)
        if row.observer is None:
            return A, B
        to = np.arange(parts.size)
        to[parts.state] += row.state.start
        A = A[..., to, :]
        B = B[..., to, :]
        A[..., parts.state] += A[..., row.state]
        A[..., parts.disturbance, : parts.size] = np.eye(parts.size)[parts.disturbance]
        B[..., parts.disturbance, :] = 0.0
        return A[..., : parts.size], B


@dataclass(frozen=True, eq=False)
class Disagreement:
    """A price on the members' disagreement over a step, in standard deviations of the states.

    One of these costs ``weight``. There are two members or more, and no observer.
    """

    dynamics: Dynamics
    weight: float

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return what steps cost (T, k)."""
        return np.asarray(self.weight * np.sum(self._apart(thetas, inputs) ** 2, axis=-1))

    def slopes(self, thetas: Array, inputs: Array) -> tuple[Array, Array]:
        """Return gradients (T, k, n_theta + m) and Gauss-Newton curvatures of that."""
        shape = thetas.shape[:2]
        apart = self._apart(thetas, inputs)
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (thetas, inputs))
        slopes = np.concatenate(self.dynamics.jacobians(*flat), axis=-1)
        slopes = slopes[..., self.dynamics.row.state, :]
        slopes = (slopes - slopes.mean(axis=0)) / self._units[:, None]
        members, rows, n, size = slopes.shape
        J = np.moveaxis(slopes, 0, 1).reshape(rows, members * n, size)
        gradient = np.einsum("rqi,rq->ri", J, apart.reshape(rows, -1))
        curvature = np.swapaxes(J, 1, 2) @ J
        twice = 2 * self.weight
        return twice * gradient.reshape(*shape, size), twice * curvature.reshape(*shape, size, size)

    @cached_property
    def _units(self) -> Array:
        return np.asarray(self.dynamics.coordinates.units * np.sqrt(len(self.dynamics.members)))

    def _apart(self, thetas: Array, inputs: Array) -> Array:
        """Return how far each member is from their mean, (T, k, members n)."""
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (thetas, inputs))
        residual = self.dynamics.residual(*flat)
        apart = (residual - residual.mean(axis=0)) / self._units
        return np.asarray(np.moveaxis(apart, 0, 1).reshape(*thetas.shape[:2], -1))


@dataclass(frozen=True)
class Task:
    """What a trajectory is to minimize: stage costs, the value at the end, what is beyond bounds.

    Bounds are those of the problem, soft ones too, and those of states (n,), ``low`` and ``high``.
    ``theta' end theta + end_slope' theta`` is the cost of what comes after the last step.
    ``weight`` is what one half-width beyond a bound costs in a step, `WEIGHT` typical stage costs,
    and ``doubt`` what a plan pays where the members of a model disagree.
    """

    problem: LinearMPC
    low: Array
    high: Array
    end: Array
    weight: float
    doubt: Disagreement | None = None
    end_slope: Array | float = 0.0

    @cached_property
    def _bounds(self) -> Bounds:
        return Bounds.of(self.problem, self.low, self.high)

    def costs(self, thetas: Array, inputs: Array) -> Array:
        """Return the costs (k,) of thetas (T + 1, k, n_theta) and inputs (T, k, m); inf for NaN."""
        with np.errstate(over="ignore", invalid="ignore"):
            stage = self.problem.deviations.stage_cost(thetas[:-1], inputs).sum(axis=0)
            end = np.sum((thetas[-1] @ self.end + self.end_slope) * thetas[-1], axis=-1)
            outside = np.sum(self._bounds.beyond(thetas[1:], -INSIDE) ** 2, axis=(0, 2))
            mixed = mixed_beyond(self.problem.deviations, thetas[:-1], inputs, -INSIDE)
            outside += np.sum(mixed**2, axis=(0, 2))
            total = stage + end + self.weight * outside
            if self.doubt is not None:
                total = total + self.doubt.costs(thetas[:-1], inputs).sum(axis=0)
        return np.where(np.isfinite(total), total, np.inf)

    def slopes(self, thetas: Array, inputs: Array) -> tuple[Array, Array]:
        """Return gradients (T, k, n_theta + m) and curvatures of steps, but for bounds of states.

        thetas (T, k, n_theta), inputs (T, k, m); curvatures (T, k, n_theta + m, n_theta + m).
        """
        W = 2 * self.problem.stage_matrix
        slopes = np.concatenate([thetas, inputs], axis=-1) @ W + self.problem.stage_slope
        curved = np.broadcast_to(W, (*inputs.shape[:2], *W.shape))
        prices = []
        if len(self.problem.mixed.F):
            over = mixed_beyond(self.problem.deviations, thetas, inputs, -INSIDE)
            rows = self.problem.bounded["mixed"].rows / mixed_half(self.problem)[:, None]
            prices.append(self._squares(over, rows))
        prices += [self.doubt.slopes(thetas, inputs)] if self.doubt is not None else []
        for slope, more in prices:
            slopes = slopes + slope
            curved = curved + more
        return slopes, curved

    def limits(self, thetas: Array) -> tuple[Array, Array]:
        """Return the bounds (..., m) of the inputs at thetas (..., n_theta)."""
        shape = *thetas.shape[:-1], self.problem.model.n_inputs
        low, high = self.problem.deviations.input_range(thetas)
        return np.broadcast_to(low, shape), np.broadcast_to(high, shape)

    def penalty(self, thetas: Array) -> tuple[Array, Array]:
        """Return gradient (..., n) and curvature (..., n, n) of what is beyond bounds."""
        scaled = self._bounds.C / self._bounds.half[:, None]
        return self._squares(self._bounds.beyond(thetas, -INSIDE), scaled)

    def _squares(self, over: Array, rows: Array) -> tuple[Array, Array]:
        weight = 2 * self.weight
        return weight * over @ rows, weight * ((rows.T * (over != 0)[..., None, :]) @ rows)


def roll_out(
    plant: TwinPlant, task: Task, policy: Policy, starts: Array, steps: int, rows: Rows
) -> tuple[Array, Array]:
    """Return thetas (steps + 1, k, n_theta) and inputs (steps, k, m) of a policy within bounds.

    It begins at ``starts`` (k, n_theta). Here and below ``rows`` (k,) are their numbers, as the
    plant knows them.
    """
    m = task.problem.model.n_inputs
    limits = task.problem.deviations.input_range

    def act(t: int, theta: Array) -> Array:
        u = policy(t, theta)
        return np.clip(np.where(np.isnan(u), 0.0, u), *limits(theta))

    return play(act, lambda t, theta, u: plant.step(theta[t], u[t], rows), starts, steps, m)


@dataclass(frozen=True)
class Plans:
    """Trajectories of k starts, with feedback and costs, which hold what is beyond bounds.

    thetas (T + 1, k, n_theta), inputs (T, k, m), gains (T, k, m, n_theta); ``turn`` is the plant's.
    """

    thetas: Array
    inputs: Array
    gains: Array
    costs: Array
    turn: Array | None = None

    def of(self, chosen: Rows | Mask) -> Plans:
        """Return some of the starts."""
        parts = self.thetas, self.inputs, self.gains
        thetas, inputs, gains = (each[:, chosen] for each in parts)
        return Plans(thetas, inputs, gains, self.costs[chosen], self.turn)


def follow(plans: Plans, t: int, theta: Array) -> Array:
    """Return the inputs (k, m) of plans at a step, from theta (k, n_theta)."""
    away = theta - plans.thetas[t]
    if plans.turn is not None:
        away -= plans.turn * np.round(away / np.where(plans.turn > 0, plans.turn, np.inf))
    return np.asarray(plans.inputs[t] + (plans.gains[t] @ away[..., None])[..., 0])


def planned(
    plant: TwinPlant,
    task: Task,
    policies: list[Policy],
    starts: Array,
    steps: int,
    rows: Rows,
    preferred: bool = False,
) -> Plans:
    """Return the best plan of each of the ``starts`` that the policies' trajectories lead to."""
    sweeps = 40  # corrections at most; after four the best of several guesses goes on
    k = len(starts)
    turn = plant.turn
    # 1e-2: bounds count so much less at first: stiff ones would end a search where it meets them
    soft = dataclasses.replace(task, weight=1e-2 * task.weight)
    found = []
    for thetas, inputs, every in _played(plant, task, policies, starts, steps, rows):
        gains = np.zeros((*inputs.shape, starts.shape[1]))
        first = Plans(thetas, inputs, gains, soft.costs(thetas, inputs), turn)
        found.append(improved(plant, soft, first, every, 4 if len(policies) > 1 else sweeps))
    ranked = np.concatenate([each.costs for each in found]).reshape(-1, k)
    parts = zip(*((each.thetas, each.inputs, each.gains) for each in found), strict=True)
    thetas, inputs, gains = (np.concatenate(each, axis=1) for each in parts)
    raced = Plans(thetas, inputs, gains, ranked.ravel().copy(), turn)
    if preferred:
        # 0.1: by which part of its cost a guess of the caller's may cost more than the best
        ranked[-1] -= 0.1 * np.abs(ranked[-1])
    best = raced.of(np.argmin(ranked, axis=0) * k + np.arange(k))
    plans = improved(plant, soft, best, rows, sweeps)
    hard = dataclasses.replace(plans, costs=task.costs(plans.thetas, plans.inputs))
    plans = improved(plant, task, hard, rows, sweeps)
    # The last search may have been damped, and its feedback with it.
    _, gains, _ = _backward(plant, task, plans, rows, np.zeros(len(rows)))
    return dataclasses.replace(plans, gains=gains)


def _played(
    plant: TwinPlant, task: Task, policies: list[Policy], starts: Array, steps: int, rows: Rows
) -> Iterator[tuple[Array, Array, Rows]]:
    """Yield thetas, inputs and row numbers of the policies' trajectories, of several at once."""
    # 100_000: steps of trajectories at once: more take memory, fewer the interpreter's time
    some = max(1, 100_000 // (steps * len(starts)))
    for first in range(0, len(policies), some):
        group = policies[first : first + some]

        def act(t: int, theta: Array, group: list[Policy] = group) -> Array:
            parts = zip(group, np.split(theta, len(group)), strict=True)
            return np.concatenate([policy(t, part) for policy, part in parts])

        every = np.tile(rows, len(group))
        yield *roll_out(plant, task, act, np.tile(starts, (len(group), 1)), steps, every), every


def improved(plant: TwinPlant, task: Task, plans: Plans, rows: Rows, rounds: int) -> Plans:
    """Return plans that no correction improves, or those after so many rounds."""
    damped = 10.0  # factor of the damping where no correction helps
    plans = copy.deepcopy(plans)
    k = len(rows)
    damping: Array = np.zeros(k)
    active: Rows = np.flatnonzero(np.isfinite(plans.costs))
    if not len(active):
        return plans
    failed: Rows = np.zeros(k, dtype=np.intp)
    for _ in bar(f"{k} plans: rounds, at most", range(rounds), timed=True):
        old = plans.of(active)
        corrections, gains, hoped = _backward(plant, task, old, rows[active], damping[active])
        plans.gains[:, active] = gains
        # A search for what the curvature does not promise would try every size and damping in vain.
        settled = hoped <= SETTLED * np.abs(old.costs)
        waiting: Rows = np.flatnonzero(~settled)
        for size in SIZES:
            if not len(waiting):
                break
            moved = dataclasses.replace(old, inputs=old.inputs + size * corrections, gains=gains)
            now = active[waiting]
            some = moved.of(waiting)
            given = partial(follow, some), some.thetas[0], len(some.inputs), rows[now]
            thetas, inputs = roll_out(plant, task, *given)
            costs = task.costs(thetas, inputs)
            better = costs < some.costs
            won = now[better]
            plans.thetas[:, won] = thetas[:, better]
            plans.inputs[:, won] = inputs[:, better]
            plans.costs[won] = costs[better]
            waiting = waiting[~better]
        lost = np.isin(np.arange(len(active)), waiting)
        failed[active] = np.where(lost, failed[active] + 1, 0)
        more = np.maximum(damped * damping[active], 1.0)
        damping[active] = np.where(lost, more, damping[active] / damped)
        little = old.costs - plans.costs[active] <= SETTLED * np.abs(old.costs)
        # Where five corrections in a row have not helped, none will.
        done = np.where(lost, failed[active] >= 5, little)
        active = np.asarray(active[~done])
        if not len(active):
            break
    return plans


def _backward(
    plant: TwinPlant, task: Task, plans: Plans, rows: Rows, damping: Array
) -> tuple[Array, Array, Array]:
    """Return corrections (T, k, m), gains (T, k, m, n_theta), and what those should save (k,)."""
    from sb3_yann.control._kernels.sweep import sweep  # compiled, or loaded, when it is needed

    problem = task.problem
    thetas = plans.thetas
    inputs = plans.inputs
    size = problem.n_theta
    states = problem.layout.state
    A, B = plant.jacobians(thetas[:-1], inputs, rows)
    slopes, curved = (np.array(each) for each in task.slopes(thetas[:-1], inputs))
    gradient, curvature = task.penalty(thetas[1:])
    slopes[1:, :, states] += gradient[:-1]
    curved[1:, :, states, states] += curvature[:-1]
    v = 2 * thetas[-1] @ task.end + task.end_slope
    V = np.tile(2 * task.end, (len(rows), 1, 1))
    v[:, states] += gradient[-1]
    V[:, states, states] += curvature[-1]
    limits = task.limits(thetas[:-1])
    # A bound of the rate moves with the previous input.
    still = problem.deviations.limits_at("u", thetas[:-1])
    moving = np.stack([a != b for a, b in zip(limits, still, strict=True)], axis=1)
    sides = np.stack(limits, axis=1) - inputs[:, None]
    damped = 2 * damping[:, None, None] * problem.stage_matrix[size:, size:]
    found = np.empty(inputs.shape), np.empty(plans.gains.shape), np.zeros(len(rows))
    F = np.ascontiguousarray(np.concatenate([A, B], axis=-1))
    sweep(F, slopes, curved, sides, moving, damped, v, V, *found)
    return found


def slopes_of_inputs(
    plant: TwinPlant, task: Task, act: Feedback, states: Array, inputs: Array
) -> Array:
    """Return the derivatives (T, k, m) of a task's costs by inputs that a feedback answers.

    ``states`` (T + 1, k, size) are the twin's rows of k episodes, ``inputs`` (T, k, m) what the
    feedback put in. The costates run backward, as in Pontryagin's principle, and slopes of the
    feedback are central differences.
    """
    problem = task.problem
    shown = plant.dynamics.row.shown
    thetas = shown(states)
    n = problem.n_theta
    A, B = plant.slopes(states[:-1], inputs, np.arange(states.shape[1]))
    own, _ = task.slopes(thetas[:-1], inputs)
    outside, _ = task.penalty(thetas[1:])
    flat = thetas[:-1].reshape(-1, n)
    limits = task.limits(flat)
    # 1e-4: half-widths of theta over which slopes of a feedback are taken
    near = np.where(np.isfinite(problem.theta_half), problem.theta_half, 1.0) * 1e-4
    gains = [
        (np.clip(act(flat + each), *limits) - np.clip(act(flat - each), *limits)) / (2 * each.sum())
        for each in np.diag(near)
    ]
    K = np.stack(gains, axis=-1).reshape(*inputs.shape, n)
    found = np.empty_like(inputs)
    costate: Array = np.zeros(states.shape[1:])
    shown(costate)[:] = 2 * thetas[-1] @ task.end + task.end_slope
    for t in reversed(range(len(inputs))):
        shown(costate)[:, problem.layout.state] += outside[t]
        found[t] = own[t][:, n:] + _pulled(B[t], costate)
        costate = _pulled(A[t], costate)
        shown(costate)[:] += own[t][:, :n] + _pulled(K[t], found[t])
    return found


def _pulled(J: Array, v: Array) -> Array:
    """Return J' v (k, p) for J (k, q, p) and v (k, q)."""
    return np.asarray((J.swapaxes(1, 2) @ v[..., None])[..., 0])


def initial_guesses(
    plant: TwinPlant, task: Task, starts: Array, steps: int, rows: Rows
) -> list[Policy]:
    """Return the policies whose trajectories plans may begin with; the first one is the MPC.

    Two have inputs on their bounds for a while, then the MPC. The last one is, for each start, the
    cheapest of these and of unconstrained laws with other weights, after such a push or without: an
    MPC that leaves a pendulum hanging shows no plan that it can swing. There is none where the MPC
    is as cheap.
    """
    problem = task.problem
    own = problem.deviations
    # Some searches begin with all inputs on a bound, for a 25th of the episode.
    pushes = [(own.u_min, 0), *((u, steps // 25) for u in (own.u_min, own.u_max))]
    first = [_pushed(*push, law_of(problem)) for push in pushes]
    laws = [lambda theta, K=K: theta @ K.T for K in _gains(problem)]
    others = [_pushed(*push, law) for law in laws for push in pushes]
    played = [*_played(plant, task, [*first, *others], starts, steps, rows)]
    costs = np.concatenate([task.costs(*pair) for *pair, _ in played]).reshape(-1, len(starts))
    cheapest = np.argmin(costs, axis=0)
    inputs = np.concatenate([each for _, each, _ in played], axis=1)
    best = inputs[:, cheapest * len(starts) + np.arange(len(starts))]
    return [*first, lambda t, _: best[t]] if cheapest.any() else first


def _pushed(u: Array, until: int, law: Feedback) -> Policy:
    """Return a policy with inputs u (m,) for some steps, those of a law after them."""
    return lambda t, theta: np.tile(u, (len(theta), 1)) if t < until else law(theta)


def _gains(problem: LinearMPC) -> Iterator[Array]:
    """Yield gains (m, n_theta) of unconstrained laws: with another weight of one error, or all."""
    errors = problem.error_system
    size = len(errors.Q)
    for chosen in (*np.eye(size, dtype=bool), np.ones(size, dtype=bool)):
        for factor in WEIGHTS:
            scale = np.where(chosen, np.sqrt(factor), 1.0)
            Q = scale[:, None] * errors.Q * scale
            cross = None if errors.cross is None else scale[:, None] * errors.cross
            if np.array_equal(Q, errors.Q):
                continue
            try:
                P = lqr.riccati(errors.model, Q, errors.R, problem.gamma, cross)
            except ValueError:  # no stabilizing solution with these weights
                continue
            K = lqr.gain(errors.model, errors.R, P, problem.gamma, cross)
            yield errors.to_input - K @ errors.to_error


@dataclass
class Planning:
    """Plans for the rest of the episode, anew where a reference or disturbance changes.

    Nothing is known of changes before they come. Feedback keeps the plant on its plan. For
    ``pause`` steps after a plan a disturbance makes no new one: an observer's estimate moves at
    every step until it has settled. At ``room`` half-widths from its plan a law, by default the
    MPC, takes over until there is a new one. ``guess`` is another law whose trajectories plans may
    begin with. ``plans`` holds the present one of each episode, the step at which it was made, and
    theta of then.
    """

    remembers = True
    plant: TwinPlant
    task: Task
    steps: int
    pause: int = 0
    room: float = np.inf
    law: Feedback | None = None
    guess: Feedback | None = None

    def __post_init__(self) -> None:
        self.plans: dict[int, tuple[int, Plans, Array]] = {}
        self.lost = set[int]()  # who has left its plan
        self._kept: dict[int, float] = {}  # what plans that are over have promised
        self._act = self.law or law_of(self.task.problem)

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        problem = self.task.problem
        constant = problem.layout.constant
        states = problem.layout.state
        known = np.isin(rows, [*self.plans])
        changed = np.zeros(len(rows), dtype=bool)
        for k in np.flatnonzero(known):
            planned_at, plan, foreseen = self.plans[rows[k]]
            for _ in range(min(t - planned_at, max(problem.layout.previews))):
                foreseen = foreseen[problem.layout.next]
            away = np.abs(theta[k] - foreseen)[constant] / problem.theta_half[constant]
            # For a reference or disturbance that has moved by 5 % of its half-width: a new plan.
            moved = ~(away <= 0.05)
            if t < planned_at + self.pause:  # an estimated disturbance may still settle
                moved[problem.layout.reference.stop - problem.layout.reference.start :] = False
            changed[k] = moved.any()
            if t < self.steps and self.room < np.inf:
                left = theta[k, states] - plan.thetas[t - planned_at, 0, states]
                if np.any(np.abs(left) > self.room * problem.theta_half[states]):
                    self.lost.add(rows[k])
        for chosen in (~known, changed):
            if chosen.any() and t < self.steps:
                self._plan(t, theta[chosen], rows[chosen])
        u: Array = np.zeros((len(rows), problem.model.n_inputs))
        if self.lost:
            u = np.nan_to_num(self._act(theta))
        for k, row in enumerate(rows):
            if row in self.plans and row not in self.lost:
                planned_at, plan, _ = self.plans[row]
                at = min(t, self.steps - 1) - planned_at
                u[k] = np.nan_to_num(follow(plan, at, theta[k : k + 1])[0])
        return np.clip(u, *self.task.limits(theta))

    def _plan(self, t: int, starts: Array, rows: Rows) -> None:
        left = self.steps - t
        guess = self.guess
        policies: list[Policy] = [lambda _, at: self._act(at)]
        preferred = guess is not None and rows[0] not in self.plans
        if rows[0] not in self.plans:
            policies = initial_guesses(self.plant, self.task, starts, left, rows)
            policies += [lambda _, at: guess(at)] if guess is not None else []
        found = planned(self.plant, self.task, policies, starts, left, rows, preferred)
        for k, row in enumerate(rows):
            self._kept[row] = self._promised(row, t)
            self.lost.discard(row)
            self.plans[row] = t, found.of(np.array([k])), starts[k].copy()

    def promised(self, count: int) -> Array:
        """Return what the plans of so many episodes said that these would cost."""
        return np.array([self._promised(row, self.steps) for row in range(count)])

    def _promised(self, row: int, until: int) -> float:
        """Return what the plans of an episode say that it costs until a step."""
        if row not in self.plans:
            return 0.0
        begun, plan, _ = self.plans[row]
        thetas = plan.thetas[: until - begun]
        costs = self.task.problem.deviations.stage_cost(thetas, plan.inputs[: until - begun])
        return self._kept[row] + float(np.sum(costs))


def value_at_end(problem: LinearMPC) -> Value:
    """Return the undiscounted value of the law, or one discounted a little where there is none."""
    try:
        return problem.value_terms(1.0)
    except ValueError:
        return problem.value_terms(0.99)
