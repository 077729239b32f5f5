"""Nearly optimal plans in a model, a policy that learns to do what they do, and its critic."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann._progress import bar
from sb3_yann._validation import Array, Feedback, Mask
from sb3_yann.compare import RULE, Scores, less_safe, no_worse, relative_costs
from sb3_yann.control import LinearMPC
from sb3_yann.evaluation import change_in_percent
from sb3_yann.improvement.simulator import Family, Imagined, Scenarios, of_law, task_of
from sb3_yann.networks.yann import LawLayer
from sb3_yann.plan import PAUSE, SETTLED, Planning, Plans, follow, slopes_of_inputs
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.rollout import Controller, Rows
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.env import LearntModel
from sb3_yann.twin.plant_twin import PlantTwin

FITS = 8  # fits to plans in a model, at most: after each the policy's own states are planned from
HARDEST = 40  # scenarios that are planned anew after a fit or a check, at most
DESCENTS = 10  # steps down the costs of a model's episodes, after the fits
NEARLY = 0.5
NEAR = 0.02
"""Share of what plans gain that a policy may lack when its fits end; a fit that brings less than
half of it, to a policy that gains half of what they do, is the last; so is a step of the descent,
where no more is lacking."""
RETURNS = 1000  # states whose returns the critic is fitted to
RETURN_STEPS = 100  # steps of a return; the MPC's value counts after them
CRITIC_BATCH = 256  # rows in a step of Adam on the critic
CRITIC_UPDATES = 200  # steps of Adam on the critic


@dataclass
class Teacher:
    """Plans the episodes of a model, and keeps what plans and their feedback do.

    Plans are those of :func:`headroom`: differential dynamic programming, which knows neither
    changes of references nor disturbances before they come. ``best`` (k,) is the least cost that a
    plan or the MPC had in each scenario. The first ``n_planned`` are planned, by default all; the
    others where a policy turns out to lack much. Policies promise what they save in the first
    ``n_usual`` ones. In a :class:`Family` lost starts count ``caution`` times as much as usual.
    """

    scenarios: Scenarios
    seed: int
    n_planned: int | None = None
    n_usual: int | None = None
    caution: float = 1.0

    def __post_init__(self) -> None:
        self.usual = slice(self.n_usual)
        self.rng = np.random.default_rng([self.seed, 4])
        model = self.scenarios.model
        self.problem = model.problem
        self.mpc = self.scenarios.play(of_law(self.problem))
        self.law = law_of(self.problem)
        self.best = self.mpc.costs.copy()
        self.known = np.zeros(len(self.scenarios), dtype=bool)
        self.steps = len(self.mpc.inputs)
        finite = self.mpc.costs[np.isfinite(self.mpc.costs)]
        unit = max(float(np.median(np.abs(finite))) / self.steps, 1e-300) if len(finite) else 1.0
        self.task = task_of(model, unit, priced=self.scenarios.members is None)
        self.earlier: list[tuple[Array, Array]] = []  # theta and inputs that others have shown
        self.taught: dict[tuple[int, int], tuple[Array, Array]] = {}  # by scenario and first step
        self.weights: NDArray[np.int64] = np.ones(len(self.scenarios), dtype=np.int64)

    @property
    def gain(self) -> float:
        """What plans gain on average: see :meth:`saved`."""
        return self.saved(self.best, slice(self.n_planned))

    def saved(self, costs: Array, part: slice | Mask = slice(None)) -> float:
        """Return what costs (k,) are below the MPC's on average, relative to those."""
        finite = np.isfinite(self.mpc.costs[part])
        mpc = self.mpc.costs[part][finite]
        more = costs[part][finite] - mpc
        return float(-relative_costs(more, mpc).mean()) if finite.any() else 0.0

    def score(self, costs: Array, price: float = 0.0, room: Array | float = 0.0) -> float:
        """Return what costs (k,) are below the MPC's in all scenarios, by which fits are ranked.

        A start counts as lost once at most: else one that falls would hide all the others. What it
        costs more than the MPC and a ``room`` counts ``price`` times besides.
        """

        def more(least: Array | float) -> Array:
            with np.errstate(invalid="ignore"):
                found = relative_costs(costs - self.mpc.costs - least, self.mpc.costs)
            return np.minimum(np.nan_to_num(found, nan=0.0, posinf=1.0, neginf=-1.0), 1.0)

        return float(-more(0.0).mean() - price * np.maximum(more(room), 0.0).mean())

    def show(self, act: Feedback | None = None, played: Imagined | None = None) -> None:
        """Plan the scenarios; those that a policy ``played``, from where it had got to.

        Where plans cost more than the MPC, or break a bound by more, the MPC is shown. A scenario
        that is planned again is shown anew: what the policy does is a guess that plans prefer, so
        that in the end neighbors do alike.
        """
        pause = PAUSE if self.scenarios.model.dynamics.row.observer is not None else 0
        chosen: NDArray[np.intp] = np.arange(len(self.scenarios))[: self.n_planned]
        begins: NDArray[np.int64] = np.zeros(len(chosen), dtype=np.int64)
        if played:
            chosen, begins = self.hardest(played)
            lost = chosen[~(played.costs[chosen] <= self.mpc.costs[chosen])]
            # 8: times that a start counts which a policy loses: twice as often after each fit
            self.weights[lost] = np.minimum(2 * self.weights[lost], 8)
        self.known[chosen] = True
        scenarios = self.scenarios.of(chosen)
        mpc = self.mpc.of(chosen)
        if played:
            scenarios = scenarios.later(played.rows[:, chosen], begins)
            mpc = scenarios.play(of_law(self.problem))
        planning = Planning(scenarios.plant, self.task, self.steps, pause, guess=act)
        plans: list[dict[int, tuple[int, Plans, Array]]] = []  # at each step

        def planned(t: int, theta: Array, rows: Rows) -> Array:
            u = planning(t, theta, rows)
            plans.append({**planning.plans})
            return u

        shown = scenarios.play(planned)
        better = shown.costs <= mpc.costs
        better &= ~less_safe(shown.unsafe, mpc.unsafe).any(axis=1)
        first = better & (begins == 0)
        self.best[chosen[first]] = np.fmin(self.best[chosen[first]], shown.costs[first])
        for i in range(len(chosen)):
            key = int(chosen[i]), int(begins[i])
            if better[i]:
                acting = [each[i] for each in plans]

                def answers(near: Array, acting: Any = acting) -> Array:
                    each = enumerate(zip(acting, near, strict=True))
                    return np.array([follow(plan, t - at, x) for t, ((at, plan, _), x) in each])

                self._keep(key, shown, i, answers)
            elif not begins[i]:
                self._keep(key, mpc, i, lambda near: self.law(near.reshape(-1, near.shape[-1])))

    def _keep(self, key: tuple[int, int], played: Imagined, i: int, answers: Feedback) -> None:
        """Keep the inputs of an episode at its thetas, and the answers to states near each."""
        thetas = played.thetas[:-1, i]
        inputs = played.inputs[:, i]
        # 3: states beside each of a plan that its feedback answers
        near = np.repeat(thetas[:, None], 3, axis=1)
        states = near[..., self.problem.layout.state]
        coordinates = self.scenarios.model.dynamics.coordinates
        # 0.1: how far they are, in standard deviations of the states in the episodes
        states += 0.1 * coordinates.units * self.rng.standard_normal(states.shape)
        rows = near.reshape(-1, near.shape[-1])
        answered = np.clip(answers(near).reshape(len(rows), -1), *self.task.limits(rows))
        coordinates.wrap(rows)
        self.taught[key] = np.concatenate([thetas, rows]), np.concatenate([inputs, answered])

    @property
    def attainable(self) -> Array:
        """What plans cost (k,); without one, their gain where the MPC's cost is nearest counts."""
        mpc = np.nan_to_num(self.mpc.costs)
        known = np.flatnonzero(self.known)
        nearest = known[np.abs(mpc[:, None] - mpc[known]).argmin(axis=1)]
        guessed = self.mpc.costs + np.nan_to_num(self.best)[nearest] - mpc[nearest]
        return np.where(self.known, self.best, guessed)

    def is_near(self, costs: Array) -> bool:
        """Return whether costs (k,) save nearly what plans do; not where nothing was planned."""
        planned = bool(self.known.any())
        return planned and self.saved(costs) >= (1 - NEAR) * self.saved(self.attainable)

    def teach(self, layer: LawLayer, updates: int) -> None:
        """Fit a layer to all that was shown."""
        weighed = [each for key, each in self.taught.items() for _ in range(self.weights[key[0]])]
        shown = zip(*self.earlier, *weighed, strict=True)
        thetas, inputs = (np.concatenate(each) for each in shown)
        fit_layer(layer, self.problem, thetas, inputs, self.rng, updates)

    def hardest(self, played: Imagined) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the scenarios in which a policy lacks most, and the steps to plan from next.

        Those that were not planned before begin at their start, as half of the others do; the rest
        amid the episode.
        """
        behind = np.where(np.isfinite(played.costs), played.costs - self.attainable, np.inf)
        unsafe = np.any(less_safe(played.unsafe, self.mpc.unsafe), axis=1)
        chosen = np.lexsort((-behind, ~unsafe))[:HARDEST]
        chosen = chosen[unsafe[chosen] | (behind[chosen] > 0) | ~self.known[chosen]]
        begins = self.rng.integers(0, self.steps, size=len(chosen))
        at_start = self.rng.random(len(chosen)) < 0.5
        begins[at_start | unsafe[chosen] | ~self.known[chosen]] = 0
        return chosen, begins

    def play(self, layer: LawLayer) -> Imagined:
        """Return the episodes of a layer in the scenarios."""
        return self.scenarios.play(controller_of(policy_of(layer, self.problem)))

    def objection(self, played: Imagined, share: float = 1.0) -> str:
        """Return what the rule of acceptance says against a policy, empty for nothing.

        Starts may cost a ``share`` of what they may cost more.
        """
        part = np.flatnonzero(np.isfinite(self.mpc.costs[self.usual]))
        mpc, policy = (Scores(each.costs[part], each.unsafe[part]) for each in (self.mpc, played))
        rule = replace(RULE, margin=share * RULE.margin)
        return no_worse(policy, mpc, mpc, rule.tolerance(mpc.costs)).reason


def imitate(
    layer: LawLayer, teacher: Teacher, updates: int, say: Callable[[str], None] = lambda text: None
) -> float:
    """Fit a layer to plans of a model's episodes, and to their feedback nearby.

    Then the policy plays these episodes in the model, and learns more where it does worse than
    plans or the MPC: from their starts, and from where it had got to (S. Ross, G. Gordon and D.
    Bagnell, *A reduction of imitation learning and structured prediction to no-regret online
    learning*, AISTATS 2011). Starts that it loses count more in the next fit. Then it descends the
    costs of a simulator's model, see :func:`refine`: at once where no plan beats the MPC, or where
    plans know what no reading shows, in a :class:`Family`. The layer ends with what cost the least.
    Return what it saves in the model: see :meth:`Teacher.saved`.
    """
    most = -np.inf
    promised = 0.0
    since = 0
    best = copy.deepcopy(layer.state_dict())
    model = teacher.scenarios.model
    descends = not isinstance(model, PlantTwin)
    mpc = teacher.mpc.costs
    better = np.any(mpc - teacher.best > SETTLED * np.abs(mpc))
    imitates = not descends or (better and not isinstance(model, Family))
    for fit in range(FITS if imitates else 0):
        teacher.teach(layer, updates)
        played = teacher.play(layer)
        score = teacher.score(played.costs)
        saved = teacher.saved(played.costs, teacher.usual)
        objection = teacher.objection(played)
        if score > most + NEAR / 2 * teacher.gain:
            since = fit
        if score > most:
            most = score
            promised = saved
            best = copy.deepcopy(layer.state_dict())
        done = teacher.is_near(played.costs)
        vain = since < fit and most >= NEARLY * teacher.gain
        over = (done and not objection) or fit == FITS - 1 or vain
        say(
            f"fit {fit + 1}, in the model: policy {change_in_percent(-saved)}, plans "
            f"{change_in_percent(-teacher.gain)}{'; ' * bool(objection)}{objection}"
            f"{'; the descent is next' * (over and descends)}"
        )
        if over:
            break
        teacher.show(policy_of(layer, teacher.problem), played)
    layer.load_state_dict(best)
    if descends:
        promised = refine(layer, teacher, updates // 2)
        say(f"descent, in the model: policy {change_in_percent(-promised)}")
    return promised


def refine(layer: LawLayer, teacher: Teacher, updates: int) -> float:
    """Let a layer descend the costs of a model's episodes; return what it saves, as `imitate`.

    The steps are of the function, not of its weights: a layer is fitted to its actions of now, less
    the slopes of the costs by them, which run back through the model. Least squares make of slopes
    what is expected at theta: plans know no set-point before it comes, a policy learns what usually
    follows. Starts that cost more than they may have a price, which rises while the rule of
    acceptance objects: a method of multipliers. The layer ends with what that rule lets through,
    and of that with what costs the least. In a :class:`Family`, where a policy cannot serve each
    start as its own plan does, it ends with what costs the least, the price included, whatever the
    rule says; the price stays, and steps are finer.
    """
    scenarios = teacher.scenarios
    mpc = teacher.mpc.costs
    known = np.flatnonzero(np.isfinite(mpc))
    if not len(known):
        return 0.0
    room = NEARLY * RULE.tolerance(mpc[known]).allowed(mpc)
    is_family = isinstance(scenarios.model, Family)
    # 40.0: how often a start counts, at first, that costs so much of what it may cost more than
    # with the MPC; twice as often after each look with an objection.
    price = 40.0 * (teacher.caution if is_family else 1.0)
    # 4: times as many steps, and as small ones, where a policy cannot know what plans do
    finer = 4 if is_family else 1
    size = 0.1 / finer  # an action's first move, root mean square
    weight = 0.0
    last = teacher.mpc
    most = (False, -np.inf)
    what = "the policy descends in the model: steps, at most"
    for k in bar(what, range(finer * DESCENTS + 1), timed=True):
        played = teacher.play(layer)
        passes = is_family or not teacher.objection(played, NEARLY)  # new starts lose more
        rank = passes, teacher.score(played.costs, price * is_family, room)
        if rank > most:
            most = rank
            saved = teacher.saved(played.costs, teacher.usual)
            best = copy.deepcopy(layer.state_dict())
        score = teacher.score(last.costs, weight, room) if k else -np.inf
        gained = teacher.score(played.costs, weight, room) - score
        slow = passes and 0 < gained < NEAR / 2 * score and teacher.is_near(played.costs)
        if gained > 0:
            objects = not passes
            present = copy.deepcopy(layer.state_dict())
            last = played
            # 1.5: times the last one's is the next, where the policy got better; else half of it
            size *= 1.5 if k else 1.0
            weight = price * bool(is_family and np.any(last.costs > mpc + room))
        else:
            layer.load_state_dict(present)
            size /= 2
        if k == finer * DESCENTS or size < 0.02 / finer or slow:  # so small a one ends the descent
            break
        if objects:
            price *= 2
        # 48_000: steps of episodes whose slopes each of these follows, about
        count = 48_000 // teacher.steps + 1
        chosen = teacher.rng.permutation(known[np.isfinite(last.costs[known])])[:count]
        if not len(chosen):
            break
        prices = np.where(last.costs > mpc + room, 1 + price, 1.0)[chosen]
        lower = _downhill(layer, teacher, scenarios.of(chosen), last.of(chosen), prices, size)
        _fit(layer, *lower, np.inf, teacher.rng, updates)
    layer.load_state_dict(best)
    return saved


def _downhill(
    layer: LawLayer,
    teacher: Teacher,
    scenarios: Scenarios,
    played: Imagined,
    prices: Array,
    size: float,
) -> tuple[th.Tensor, th.Tensor]:
    """Return the thetas of episodes that a layer played, and its actions moved down the slopes.

    Each of the k episodes has its price; the moves' root mean square is ``size``.
    """
    farthest = 3.0  # moves of an action, in times their root mean square
    problem = teacher.problem
    act = policy_of(layer, problem)
    slopes = slopes_of_inputs(scenarios.plant, teacher.task, act, played.rows, played.inputs)
    slopes *= problem.u_half
    sizes = np.linalg.norm(slopes, axis=(0, 2))
    steep = np.maximum(sizes, np.finfo(float).tiny)
    # 10.0: slopes of an episode, in times the median's, at most
    slopes *= (prices * np.minimum(1.0, 10.0 * np.median(sizes) / steep))[:, None]
    moves = -slopes / (np.sqrt(np.mean(slopes**2)) or 1.0)
    moves = size * np.clip(moves, -farthest, farthest).reshape(-1, moves.shape[-1])
    at = th.as_tensor(played.thetas[:-1].reshape(len(moves), -1))
    with th.no_grad():
        return at, layer(at) + th.as_tensor(moves, dtype=th.float32)


def fit_layer(
    layer: LawLayer,
    problem: LinearMPC,
    rows: Array,
    inputs: Array,
    rng: np.random.Generator,
    updates: int,
) -> None:
    """Fit a layer to inputs (rows, m) at theta: Huber's loss on actions in [-1, 1], with Adam.

    Rows that are not finite are left out. The networks go on from where they are.
    """
    # Errors of an action, in half-ranges, from which they count by their size rather than its
    # square: where plans go one way or the other, their mean goes nowhere. Labels on a bound lie as
    # far beyond it, so that the slope does not vanish on the way.
    huber = 0.1
    wanted = np.clip((inputs - problem.deviations.u_min) / problem.u_half - 1, -1, 1)
    finite = np.isfinite(rows).all(axis=1) & np.isfinite(wanted).all(axis=1)
    wanted += huber * np.sign(wanted) * (np.abs(wanted) == 1)
    at = th.as_tensor(rows[finite])
    _fit(layer, at, th.as_tensor(wanted[finite], dtype=th.float32), huber, rng, updates)


def _fit(
    layer: LawLayer,
    at: th.Tensor,
    to: th.Tensor,
    largest: float,
    rng: np.random.Generator,
    updates: int,
) -> None:
    """Fit a layer to actions (rows, m) at theta (rows, n_theta), see :meth:`LawLayer.descend`."""
    count = range(updates if len(at) else 0)
    shown = bar("the policy learns: steps of Adam", count, timed=True)
    # Batches of 512 rows; the rate begins at 1e-2 and falls to zero.
    steps = ((rng.integers(len(at), size=512), 1e-2 * (1 - k / updates)) for k in shown)
    layer.descend(at, to, largest, steps)


def policy_of(layer: LawLayer, problem: LinearMPC) -> Feedback:
    """Return an actor of now as a function from theta (rows, n_theta) to inputs (rows, m)."""
    middle = (problem.deviations.u_max + problem.deviations.u_min) / 2
    half = problem.u_half
    act = layer.frozen()
    return lambda theta: np.asarray(middle + half * act(theta))


def controller_of(act: Feedback) -> Controller:
    """Return a policy as what acts in episodes side by side; on what is not finite, as at rest."""

    def controller(t: int, theta: Array, rows: Rows) -> Array:
        return act(np.where(np.isfinite(theta).all(axis=1, keepdims=True), theta, 0.0))

    return controller


def refit_critic(policy: StartsAsMPC, twin: LearntModel, seed: int) -> None:
    """Fit the critics to the returns of the policy in the twin, from inputs near its own."""
    problem = policy.problem
    rng = np.random.default_rng([seed, 2])
    act = policy_of(copy.deepcopy(policy.actor.mu).cpu(), problem)
    members = len(twin.dynamics.members)
    starts = twin.starts.draw_logged(RETURNS // members * members, rng)
    seen = twin.dynamics.row.shown(starts)
    first = act(seen)
    # The critic must know its slope in the first input.
    first = first + 0.1 * problem.u_half * rng.standard_normal(first.shape)
    first = np.clip(first, problem.deviations.u_min, problem.deviations.u_max)
    costs = _discounted(policy, twin, act, starts, first)
    returns = policy.critic.offset - policy.critic_options.reward_scale * costs
    known = np.isfinite(returns)
    if np.count_nonzero(known) < CRITIC_BATCH:  # too few to say anything
        return
    scaled = (first - problem.deviations.u_min) / problem.u_half - 1
    _fit_critic(policy, np.hstack([seen, scaled])[known], returns[known], rng)
    policy.critic_target.load_state_dict(policy.critic.state_dict())


def _discounted(
    policy: StartsAsMPC, twin: LearntModel, act: Feedback, at: Array, u: Array
) -> Array:
    """Return the discounted costs (rows,) of inputs u, then of the policy; NaN if it leaves."""
    problem = policy.problem
    gamma = policy.gamma
    dynamics = twin.dynamics
    starts, u = (each.reshape(len(dynamics.members), -1, each.shape[-1]) for each in (at, u))
    shown = dynamics.row.shown
    with np.errstate(all="ignore"):
        rows, inputs = dynamics.roll_out(act, dynamics.step(starts, u), RETURN_STEPS)
        thetas = shown(rows)
        stage = problem.deviations.stage_cost(thetas[:-1], inputs)
        end = problem.value_terms(gamma).at(thetas[-1])
        later = np.tensordot(gamma ** np.arange(RETURN_STEPS), stage, axes=1)
        later = later + gamma**RETURN_STEPS * end
        # What leaves the log is not known, and may be many times as dear as all the rest.
        later = np.where(twin.limits.violated(rows).any(axis=0), np.nan, later)
        return np.asarray(problem.deviations.stage_cost(shown(starts), u) + gamma * later).ravel()


def _fit_critic(
    policy: StartsAsMPC, inputs: Array, returns: Array, rng: np.random.Generator
) -> None:
    """Take steps of Adam on the critics' squared errors, in units of the returns' spread.

    ``inputs`` (rows, n_theta + m) are theta and actions.
    """
    critic = policy.critic
    points = th.as_tensor(inputs).to(policy.device)
    wanted = th.as_tensor(returns, dtype=th.float32)[:, None].to(policy.device)
    unit = float(np.std(returns)) or 1.0
    if critic.scales_itself and policy.critic_updates == 0:
        critic.batch = points
        critic.scale_values()
    optimizer = th.optim.Adam(critic.parameters(), lr=1e-3)
    for k in range(CRITIC_UPDATES):
        optimizer.param_groups[0]["lr"] = 1e-3 * (1 - k / CRITIC_UPDATES)
        rows = th.as_tensor(rng.integers(len(returns), size=CRITIC_BATCH), device=policy.device)
        optimizer.zero_grad()
        loss = sum(
            th.mean(((each - wanted[rows]) / unit) ** 2)  # each quantile where it has several
            for each in critic.values(points[rows])
        )
        loss.backward()  # type: ignore[union-attr]
        optimizer.step()
    optimizer.zero_grad()
