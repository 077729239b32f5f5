"""What a policy changes on the plant: an interval over all twins that the log does not refute.

Each twin replays the log's own episodes, twice: with the MPC and with the policy. At each step it
adds what it had missed there: loads and noise are those of the log, and the policy alone differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sb3_yann._progress import bar
from sb3_yann._validation import Array, Feedback
from sb3_yann.compare import RULE
from sb3_yann.control.mpc.bound_excess import costs_of
from sb3_yann.rollout import padded
from sb3_yann.twin.dynamics import Dynamics, law_of, play
from sb3_yann.twin.env import EACH, Starts
from sb3_yann.twin.log import Episode, more_of, records

DEPTHS = 2, 4  # samples that a memory reaches back, the fewest first
REMEMBERED = (
    "errors that follow earlier inputs and errors, as in this log, perhaps because of a lag or a "
    "load that lasts"
)


class Actuator(NamedTuple):
    """How what acts on a plant may follow the inputs, where nothing shows it.

    ``size`` is a lag's pole; of a rate limit and of a play it is in half-widths of the inputs.
    """

    kind: str
    size: float

    def __str__(self) -> str:
        """Name it."""
        return f"a {self.kind} of {self.size:g}{' half-ranges' * (self.kind != LAG)}"

    def moved(self, held: Array, u: Array, half: Array) -> Array:
        """Return where it is after a sample with inputs, all (..., m)."""
        if self.kind == LAG:
            return self.size * held + (1 - self.size) * u
        room = self.size * half
        end, about = (u, held) if self.kind == "rate limit" else (held, u)
        return np.clip(end, about - room, about + room)

    def behind(self, inputs: Array, half: Array) -> Array:
        """Return what acts in an episode with inputs (T, ..., m); it begins with the first."""
        held = inputs.copy()
        for t in range(1, len(held)):
            held[t] = self.moved(held[t - 1], inputs[t], half)
        return held


LAG = "lag with a pole"  # names a kind, as the others are named by themselves
# Poles; half-ranges of the input a sample; half-ranges of play on each side. What is between two is
# told by the nearer one. The first, without a lag, is no actuator.
SIZES = {LAG: (0, 0.3, 0.5, 0.7), "rate limit": (0.06, 0.12, 0.2, 0.3), "play": (0.03, 0.06, 0.12)}
ACTUATORS = tuple(Actuator(kind, size) for kind, sizes in SIZES.items() for size in sizes)


@dataclass(frozen=True)
class Judge:
    """A twin that a log may refute, fitted without each fold of the episodes.

    Member k has not seen the episodes whose number is k modulo the members. ``says`` is what sets
    it apart; inputs go through its ``actuator``. Where it is ``refuted``, predicts held-out
    episodes surely worse than the twin, it counts with a memory alone: dynamics that both lack may
    feign that.
    """

    dynamics: Dynamics
    says: str = ""
    refuted: bool = False
    actuator: Actuator = ACTUATORS[0]


class Forecast(NamedTuple):
    """What a policy changes, relative to the MPC's cost: -0.02 is 2 % less."""

    change: float
    low: float
    high: float
    cure: str
    """What would make the interval narrower."""
    worst: float = 0.0
    """The largest increase of a start, in mean costs of the MPC: also from new set-points."""
    objection: str = ""
    """What the acceptance rule says against it, from new starts in the twin; empty for nothing."""


class _Replays:
    """The episodes of a log side by side, with what comes of policies in a judge.

    Shorter ones count until their end. With a ``depth`` the judge has a memory: errors follow the
    inputs and errors of so many samples before.
    """

    def __init__(self, judge: Judge, episodes: Sequence[Episode], depth: int) -> None:
        self.dynamics = judge.dynamics
        self.actuator = judge.actuator
        self.half = judge.dynamics.problem.u_half
        self.members = len(judge.dynamics.members)
        self.depth = depth
        self.unexplained = 1.0  # share of the errors of one step on held-out episodes
        self.units = judge.dynamics.coordinates.units
        row = self.dynamics.row
        self.rows = padded([each.thetas for each in episodes])
        self.inputs = padded([each.actions for each in episodes])
        self.alive = np.arange(len(self.inputs))[:, None] < [len(each) for each in episodes]
        alive = self.alive[:, None, :, None]
        rows, inputs = (
            np.repeat(each[:, None], self.members, axis=1) for each in (self.rows[:-1], self.inputs)
        )
        with np.errstate(all="ignore"):
            acting = self.actuator.behind(inputs, self.half)
            predicted = np.stack([*map(self.dynamics.step, rows, acting)])
        its = predicted[..., row.state]
        turned = judge.dynamics.coordinates.nearest(self.rows[1:, None, :, row.state], its)
        errors = turned - its
        self.errors = np.where(alive, errors, 0.0)  # (T, members, N, n)
        self.weights = None
        if depth:
            made = [self._regressors(t, r, inputs, self.errors) for t, r in enumerate(rows)]
            basis = np.stack(made)
            self.weights = self._memory(basis)
        if self.weights is not None:
            remembered = np.einsum("tmnk,mkj->tmnj", basis, self.weights)
            self.errors = np.where(alive, self.errors - remembered, 0.0)

    @property
    def noise_alone(self) -> bool:
        """Whether the errors are those of white sensor noise v: ``v(t + 1) - A v(t)``.

        With variances s they have the variances ``s + (A * A) s``, and ``-A diag(s)`` is their
        covariance with the errors before. A lag, backlash or load moves that up, and so does a poor
        fit: for every state most members must show nearly all of it.
        """
        state = self.dynamics.row.state
        some = np.argwhere(self.alive)
        some = some[:: -(-len(some) // 500)]  # 500: samples at which A is taken, about
        at = tuple(some.T)
        with np.errstate(all="ignore"):
            A = self.dynamics.jacobians(self.rows[:-1][at][None], self.inputs[at][None])[0]
            A = A[..., state, state]  # (members, samples, n, n)
            variances = np.sum(self.errors**2, axis=(0, 2))  # (members, n)
            found = np.einsum("tmki,tmkj->mij", self.errors[1:], self.errors[:-1])
            grown = np.eye(A.shape[-1]) + np.mean(A**2, axis=1)
            s = np.maximum(np.linalg.pinv(grown) @ variances[..., None], 0.0).swapaxes(1, 2)
            expected = -A.mean(axis=1) * s
            weighted = expected / variances[:, None]
            share = np.sum(found * weighted, axis=2) / np.sum(expected * weighted, axis=2)
        return bool(np.all(np.median(share >= 0.8, axis=0)))

    def left(self, free: bool) -> Array:
        """Return mean logarithms of squared held-out errors (N,): of one step, or of free runs.

        The latter, of the linear model made stable, tell more where sensors alone err.
        """
        number = np.arange(self.rows.shape[1])
        unseen = self.errors[:, number % self.members, number] / self.units  # (T, N, n)
        if free:
            A = self.dynamics.problem.deviations.model.A * self.units / self.units[:, None]
            A /= max(1.0, float(np.abs(np.linalg.eigvals(A)).max()))
            for t in range(1, len(unseen)):
                unseen[t] += unseen[t - 1] @ A.T
        # Squared errors of 1e-20 of how far the states move are none.
        sizes = np.log(np.sum(unseen**2, axis=-1) + 1e-20)
        return np.asarray(np.sum(sizes * self.alive, axis=0) / self.alive.sum(axis=0))

    def new_given(self, some: int, rng: np.random.Generator) -> Array:
        """Return references and loads (T, N * some, p) of new episodes, ``some`` like each logged.

        A smoothed bootstrap (Silverman, *Density Estimation*, section 6.4.1): at each step mean
        and variance over the episodes stay.
        """
        part = self.dynamics.row.given
        own = self.dynamics.problem.deviations
        logged = self.rows[:-1, :, part]
        count, p = logged.shape[1:]
        width = count ** (-1 / (4 + p))  # of a kernel, in standard deviations
        mean = logged.mean(axis=1, keepdims=True)
        drawn = rng.integers(count, size=(2, count * some))
        apart = logged[:, drawn[0]] - logged[:, drawn[1]]
        moved = np.repeat(logged - mean, some, axis=1) + width * apart / np.sqrt(2)
        new = mean + moved / np.sqrt(1 + width**2)
        return np.asarray(np.clip(new, own.theta_min[part], own.theta_max[part]))

    def costs(self, act: Feedback, starts: Array, given: Array | None = None) -> Array:
        """Return what episodes like each logged one cost with a policy, (members, N, some).

        Those that go on as episode i does begin at ``starts[i]`` (some, size). What is ``given``,
        (T, N * some, p), is as logged by default.
        """
        problem = self.dynamics.problem
        own = problem.deviations
        row = self.dynamics.row
        count, some, size = starts.shape
        steps, _, m = self.inputs.shape
        like = np.repeat(np.arange(count), some)
        alive = self.alive[:, like]
        missed = self.errors[:, :, like]
        held = np.repeat(self.inputs[None, 0, like], self.members, axis=0)

        def inputs_at(t: int, rows: Array) -> Array:
            u = act(np.nan_to_num(row.shown(rows).reshape(-1, problem.n_theta)))
            return np.clip(u, own.u_min, own.u_max).reshape(*rows.shape[:2], m)

        def step(t: int, rows: Array, inputs: Array) -> Array:
            if self.weights is not None:
                missed[t] += self._regressors(t, rows[t], inputs, missed) @ self.weights
            held[:] = self.actuator.moved(held, inputs[t], self.half)
            after: Array = self.dynamics.step(rows[t], held) + missed[t] @ row.spread.T
            self.dynamics.coordinates.wrap(after)
            if self.actuator.size:  # the law remembers its inputs, not what came of them
                after[..., problem.layout.previous] = inputs[t][..., : problem.layout.n_previous]
            row.clip(after)
            after[:, ~alive[t]] = rows[t][:, ~alive[t]]
            return after

        with np.errstate(all="ignore"):
            begins = np.repeat(starts.reshape(1, -1, size), self.members, axis=0)
            if given is None:
                given = self.rows[:-1, like][..., row.given]
            rows, inputs = play(inputs_at, step, begins, steps, m, (row.given, given))
            found, _ = costs_of(problem, row.shown(rows), inputs, alive[:, None])
        found = np.where(np.isfinite(found), found, np.inf)
        return np.asarray(found.reshape(self.members, count, some))

    def _regressors(self, t: int, rows: Array, inputs: Array, missed: Array) -> Array:
        ago = range(1, self.depth + 1)
        past = (of[t - k] if t >= k else 0 * of[0] for of in (inputs, missed) for k in ago)
        one = np.ones((*rows.shape[:-1], 1))
        x = rows[..., self.dynamics.row.state]
        return np.concatenate([one, x, inputs[t], *past], axis=-1)

    def _memory(self, basis: Array) -> Array | None:
        """Return weights (members, k, n) of a memory; None where there are few rows.

        An actuator that lags, backlash and a load that lasts show in these terms, an ARMAX model's
        (Ljung, *System Identification*, section 4.2).
        """
        count = self.rows.shape[1]
        plain = 1 + self.errors.shape[3] + self.inputs.shape[2]
        known = self.alive.copy()
        known[: self.depth] = False
        # 4: steps of a log for each coefficient, at least
        if known.sum() < 4 * basis.shape[-1] or count < 2:
            return None
        weights = []
        left = np.zeros(2)
        for k in range(self.members):
            unseen = np.arange(count) % self.members == k
            fit = known & ~unseen if np.any(known & ~unseen) else known
            test = known & unseen if np.any(known & unseen) else known
            z = basis[:, k]
            e = self.errors[:, k]
            weights.append(_ridge(z[fit], e[fit]))
            rests = e - z @ weights[-1], e - z[..., :plain] @ _ridge(z[fit][:, :plain], e[fit])
            left += [np.sum((each[test] / self.units) ** 2) for each in rests]
        self.unexplained = float(left[0] / left[1]) if left[1] > 0 else 1.0
        return np.array(weights)


def _ridge(z: Array, y: Array) -> Array:
    """Return weights (k, n) of standardized regressors z (N, k); the first one is constant."""
    size = np.sqrt(np.mean(z**2, axis=0))
    size = np.where(size > 0, size, 1.0)
    z = z / size
    gram = z.T @ z + 1e-3 * len(z) * np.eye(z.shape[1])  # a ridge of standardized regressors
    return np.asarray(np.linalg.solve(gram, z.T @ y) / size[:, None])


def forecast(
    judges: Sequence[Judge],
    episodes: tuple[Episode, ...],
    starts: Starts,
    act: Feedback,
    loosest: str,
) -> Forecast:
    """Return what a policy changes on the plant: 90 % of true changes shall lie inside.

    It is the union of the judges' intervals, of runs from the log's own starts, and of others from
    the box of all starts at new set-points and loads, which no policy was fitted to. Where its
    errors follow earlier inputs and errors, a judge is asked again with memories of them; where
    they are those of noisy sensors alone, free runs say which judges the log refutes, as output
    errors do (Ljung, section 7.2). The first judge is the twin's own: there new starts must keep
    the rule for the worst ones, too, and what its memories change, they may by half as much again.
    ``loosest`` is the input that follows the MPC most closely.
    """
    problem = judges[0].dynamics.problem
    law = law_of(problem)
    independent = sum(len(each[::2]) for each in records(problem, episodes))
    count = len(episodes)
    rng = np.random.default_rng(0)
    some = -(-100 // count)  # so that a hundred runs begin anew
    drawn = starts.draw(count * some, rng, np.repeat(np.arange(count), some))
    own = [_Replays(judges[0], episodes, 0)]
    noisy = own[0].noise_alone
    if not noisy:
        own += [_Replays(judges[0], episodes, depth) for depth in DEPTHS]
    # A memory must explain 2 % of the errors of one step on held-out episodes.
    own = [each for each in own if not each.depth or each.unexplained < 0.98]
    best = min(own, key=lambda each: each.unexplained)
    logged = np.stack([each.thetas[:1] for each in episodes]), None
    new = drawn.reshape(count, some, -1), own[0].new_given(some, rng)
    found: list[tuple[float, float, float, str]] = []
    worst = -np.inf
    objection = ""
    for judge in bar("forecasts by models of the log", judges, timed=True):
        for its in own:
            if judge.refuted and not (its.depth and its is best):
                continue
            replays = its if judge is judges[0] else _Replays(judge, episodes, its.depth)
            if surely_worse(replays.left(noisy) - its.left(noisy)):
                continue
            says = REMEMBERED if its.depth else judge.says
            played = [[replays.costs(each, *of) for each in (law, act)] for of in (logged, new)]
            runs = [each.reshape(len(each), -1) for each in played[1]]
            with np.errstate(all="ignore"):
                objection = objection if found else _objection(*runs)
            for k, (mpc, policy) in enumerate(played):
                means = mpc.mean(axis=2), policy.mean(axis=2)
                middle, low, high = _changed(*means, independent, runs)
                # 0.5: of what a memory changes, that it misses: behind noise it knows a part
                own_memory = its.depth and judge is judges[0]
                missed = 0.5 * (middle - found[k][0]) if own_memory else 0.0
                found.append((middle, low + min(missed, 0.0), high + max(missed, 0.0), says))
                with np.errstate(all="ignore"):
                    most = np.max(policy - mpc) / np.abs(mpc).mean()
                worst = max(worst, float(np.nan_to_num(most, nan=np.inf)))
    change = (found[0][0] + found[1][0]) / 2
    widest = max(found, key=lambda each: each[2])
    cure = _cure(*widest, independent, loosest, partial(more_of, problem, episodes))
    low = min(each[1] for each in found)
    # Of few episodes it is not known how many starts lie where a policy acts.
    high = widest[2] if len(starts.first) >= EACH else max(widest[2], -1e-9)
    return Forecast(change, low, high, cure, worst, objection)


def _objection(mpc: Array, policy: Array) -> str:
    """Return what the acceptance rule says of the worst starts of all members, by their costs."""
    tolerance = replace(RULE.tolerance(mpc), saved=float(np.mean(mpc - policy)))
    excess = tolerance.excess(mpc, policy).ravel()
    if excess.max() > tolerance.worst_start:
        return "one costs far more than with the MPC"
    return tolerance.objection(excess).partition(": start")[0]


def surely_worse(behind: Array) -> NDArray[np.bool_]:
    """Return whether scores (..., episodes) are behind others, by two standard errors on average.

    Of five episodes or more it may as well be each of them: runs that blow up vary.
    """
    known = behind[..., np.isfinite(behind).reshape(-1, behind.shape[-1]).all(axis=0)]
    error = known.std(axis=-1, ddof=1) / np.sqrt(known.shape[-1])
    each = (known > 0).all(axis=-1) & (known.shape[-1] >= EACH)
    # 2.0: standard errors by which a judge predicts held-out episodes worse that is refuted
    return np.asarray((known.mean(axis=-1) > 2.0 * error) | each)


def _changed(
    mpc: Array, policy: Array, independent: int, runs: Sequence[Array]
) -> tuple[float, float, float]:
    """Return a change relative to the MPC, and the ends of its interval; costs are (members, N).

    ``runs``, (members, .) of MPC and policy, are from new starts: of few episodes they tell how
    much starts vary. Fits to so few err alike, which is why the interval has room then.
    """
    one_sided = 0.95  # probability that a change is not above an interval's end, or not below
    if independent >= EACH:
        runs = mpc, policy
    with np.errstate(all="ignore"):
        ratios = (policy - mpc).mean(axis=1) / np.abs(mpc).mean(axis=1)  # (members,)
        size = np.abs(runs[0])
        changes = runs[1] - runs[0]
        about = (changes.mean(axis=1) / size.mean(axis=1)).mean()
    if not np.isfinite([*ratios, about]).all() or independent < 2:
        return 0.0, -np.inf, np.inf
    mean = float(ratios.mean())
    likely = [stats.t.ppf(one_sided, k - 1) for k in (independent, max(len(ratios), 2))]
    room = 0.0
    if independent < EACH:
        likely[0] = stats.norm.ppf(one_sided)
        room = RULE.least_gain * bool(np.any(policy != mpc) or changes.any())
    count = changes.shape[1]
    # Most of a gain or a loss may lie in few starts: weights at random (Rubin, Ann. Stat. 9,
    # 1981), as far out as brings normal changes to what is likely of them.
    # 10_000: fifty of the weights lie beyond the farthest end, at .5 %
    weights = np.random.default_rng(0).dirichlet(np.full(count, independent / count), 10_000)
    cost = np.maximum(weights @ size.mean(axis=0), 1e-300)
    drawn = weights @ changes.mean(axis=0) / cost - about
    out = stats.norm.cdf(likely[0] * np.sqrt((1 + 1 / independent) / (1 - 1 / count)))
    fits = likely[1] * np.sqrt((len(ratios) - 1) * ratios.var())
    down, up = np.hypot(np.quantile(drawn, (1 - out, out)), fits) + room
    return mean, mean - float(down), mean + float(up)


def _cure(
    middle: float,
    low: float,
    high: float,
    says: str,
    independent: int,
    loosest: str,
    more: Callable[[int], str],
) -> str:
    """Return what would settle a change whose interval contains zero."""
    if not np.isfinite(high - low):
        return "log more episodes"
    if middle >= 0 or says == REMEMBERED:
        slow = says == REMEMBERED or says.endswith("actuators")
        kind = " for longer than the actuator takes, and any load" if slow else ""
        which = f"; with {says}, the change is {100 * low:+.2g} to {100 * high:+.2g} %"
        return f"log held steps of {loosest}{kind}{which if says else ''}"
    needed = independent * min(((high - middle) / middle) ** 2, 100.0)
    return f"log about {more(max(int(np.ceil(needed)), EACH, independent) - independent + 1)} more"
