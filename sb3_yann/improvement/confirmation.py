"""Whether a policy is no worse than the MPC: on every member of a twin, or in pairs in a simulator.

In a simulator pairs of episodes are played until they are decisive: the plant decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, Feedback
from sb3_yann.compare import (
    LARGEST_EXCESS,
    RULE,
    UNSAFE,
    Difference,
    PairedTrial,
    Scores,
    Starts,
    Tolerance,
    Verdict,
    less_safe,
    looks,
    mean_change,
    no_worse,
    unsafe_columns,
)
from sb3_yann.control.mpc.bound_excess import BoundExcess, BoundNames, costs_of
from sb3_yann.improvement.imitation import HARDEST, NEARLY, controller_of
from sb3_yann.improvement.simulator import Scenarios, Simulator, of_law
from sb3_yann.rollout import Rows, Trajectories
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.env import RARE
from sb3_yann.twin.log import Episode
from sb3_yann.twin.plant_twin import PlantTwin

MARGIN = 0.01  # what one start around the log may cost more on one member, in mean costs of the MPC
WINDOW = 200  # steps that are planned of a run of more than twice as many


@dataclass(frozen=True)
class Check:
    """One comparison with the MPC in the twin.

    Attributes
    ----------
    iteration : int
    accepted : bool
    reason : str
        Why not; empty where it was.
    change : float
        Mean cost against the MPC's, over all starts and members: -0.02 is 2 % less.
    worst : float
        The largest increase of one start on one member, in mean costs of the MPC; of what passes,
        also from new starts, and in every model of a forecast.
    safe : bool
        Whether no start violates more than with the MPC.
    logged, error : float
        Mean cost against the MPC's of the episodes that go on as those of the log, and its standard
        error: over the logged episodes, and over the members. In a simulator: what an episode costs
        against the MPC's on average, relative to its own cost, and the standard error of that.
    final : bool
        Whether it decided in the end.
    interval : tuple of float, optional
        Where the change lies, with 90 %. In a simulator over all looks; in a twin on the plant, see
        :meth:`PlantTwin.forecast`: then ``logged`` and ``error`` are its forecast and half-width.
    starts : int
        Of a simulator, from which policy and MPC played.
    mpc_exceeds : int
        Of these, from which the MPC exceeds a hard bound of the problem.
    """

    iteration: int
    accepted: bool
    reason: str
    change: float
    worst: float
    safe: bool
    logged: float = 0.0
    error: float = 0.0
    final: bool = False
    interval: tuple[float, float] | None = None
    starts: int = 0
    mpc_exceeds: int = 0

    @property
    def starts_in_words(self) -> str:
        """From how many starts of a simulator, and of which; empty in a twin."""
        which = f"{self.starts} new starts" if self.final else f"the first {self.starts} starts"
        return which * bool(self.starts)

    @property
    def verdict(self) -> str:
        """Whether it was accepted, or why not, in words."""
        if self.accepted:
            return "accepted" if self.final else "no objection"
        return self.reason or "too little, or not sure"


@dataclass
class Trial:
    """Starts (members, starts, size) on every member of a twin, and what came of the MPC there.

    The first ``n_known`` of each member begin as the log does, the others around it. Each goes on
    with references and disturbances of the logged episode ``follow`` (starts,); with -1 its own
    stay.
    """

    twin: PlantTwin
    starts: Array
    n_known: int
    follow: Any

    @classmethod
    def draw(cls, twin: PlantTwin, count: int, rng: np.random.Generator) -> Trial:
        """Return a trial on new starts, the same for every member.

        Those that begin as the log does go on so, one logged episode after the other: a policy that
        gains at set-points that stay may lose where they change. Every other one has set-points
        between those of the log, which stay.
        """
        starts = twin.starts
        drawn = np.concatenate([starts.draw_between(count, rng), starts.draw_around(count, rng)])
        between = drawn[:, twin.dynamics.row.given].size > 0
        follow = np.full(len(drawn), -1)
        logged = np.arange(count)[int(between) :: 1 + between]
        follow[logged] = np.arange(len(logged)) % len(twin.episodes)
        drawn[logged] = starts.draw(len(logged), rng, follow[logged])
        return cls(twin, np.repeat(drawn[None], len(twin.dynamics.members), axis=0), count, follow)

    def __post_init__(self) -> None:
        episodes = self.twin.episodes
        part = self.twin.dynamics.row.given
        self.steps = max(map(len, episodes))
        self.window = WINDOW if self.steps > 2 * WINDOW else self.steps  # steps that are planned
        members, count = self.starts.shape[:2]
        # Which of all starts, member by member, begin as the log does.
        self.known = np.tile(np.arange(count) < self.n_known, members)
        self.given = np.repeat(self.starts[:1, :, part], self.steps, axis=0)
        for number, each in enumerate(episodes):
            rows = each.thetas[np.minimum(np.arange(self.steps), len(each))][:, part]
            self.given[:, self.follow == number] = rows[:, None]
        runs = self._run(law_of(self.twin.problem))
        self.rows = runs[0]
        self.far = np.nan_to_num(self._beyond(self.rows), nan=np.inf)
        self.mpc = self._outcome(*runs)
        self.mean = float(np.abs(self.mpc.costs[self.known]).mean())

    def play(self, act: Feedback) -> Scores:
        """Return what comes of a policy."""
        return self._outcome(*self._run(act))

    def _outcome(self, thetas: Array, inputs: Array) -> Scores:
        twin = self.twin
        with np.errstate(all="ignore"):
            costs, excess = costs_of(twin.problem, twin.dynamics.row.shown(thetas), inputs)
        costs = costs.ravel()
        excess = BoundExcess(*(each.ravel() for each in excess))
        # 0.01: how much farther than the MPC a run may leave what the log shows, in its widths
        left = ~(self._beyond(thetas) <= self.far + 0.01) & self.known
        unsafe = unsafe_columns(left, 0, ~np.isfinite(costs), excess)
        return Scores(costs, unsafe, np.zeros((len(costs), 0), dtype=bool))

    def _run(self, act: Feedback) -> tuple[Array, Array]:
        with np.errstate(all="ignore"):
            return self.twin.dynamics.roll_out(act, self.starts, self.steps, self.given)

    def _beyond(self, thetas: Array) -> Array:
        """Return how far each run gets beyond what the log shows, in its widths; 0 inside."""
        limits = self.twin.limits
        x = thetas[1:][..., self.twin.dynamics.row.state]
        over = np.maximum(x - limits.high, limits.low - x) / (limits.high - limits.low)
        return np.asarray(np.maximum(over, 0.0).max(axis=(0, -1)).ravel())

    def check(self, iteration: int, played: Scores) -> Check:
        """Compare a policy with the MPC, by what came of it."""
        known = self.known
        mean = self.mean
        excess = played.costs - self.mpc.costs
        less = less_safe(played.unsafe, self.mpc.unsafe).any(axis=1)
        mpc = self.mpc.at(known)
        allowed_more = RULE.tolerance(mpc.costs, BoundNames.of(self.twin.problem))
        reason = no_worse(played.at(known), mpc, mpc, allowed_more).reason
        reason = reason.replace(UNSAFE[0], "states beyond what the log shows")
        logged, error = self._as_logged(excess)
        if not reason and not logged <= 0:
            reason = f"episodes like the log's cost {100 * logged / mean:.2g} % more"
        if not reason and less.any():
            worst = int(np.argmax(np.where(less, played.unsafe[:, LARGEST_EXCESS], -1)))
            broken = allowed_more.exceeded(played, worst) or "the cost is not finite"
            problem = self.twin.problem
            rows = self.starts.reshape(-1, self.starts.shape[-1])
            theta = problem.units.to_plant(self.twin.dynamics.row.shown(rows[worst]))
            values = zip(problem.labels(units=True), theta, strict=True)
            where = ", ".join(f"{name} = {value:.3g}" for name, value in values)
            reason = f"outside the log, from {where}, {broken}"
        beyond = (excess - self.room())[~known]
        if not reason and not np.all(beyond <= 0):
            more = 100 * excess[~known][np.argmax(beyond)] / mean
            reason = f"a start outside the log costs {more:.3g} % of the mean cost more"
        shown = float(excess[known].mean()) / mean, float(excess[known].max()) / mean
        of_log = logged / mean, error / mean
        return Check(iteration, not reason, reason, *shown, not less.any(), *of_log)

    def _as_logged(self, excess: Array) -> tuple[float, float]:
        """Return the mean of the starts that go on as the log does, and its standard error.

        The episodes of the log are a sample of the plant's, the members one of the twins that such
        a log could have made.
        """
        by_member = excess.reshape(self.starts.shape[:2])
        numbers = self.follow[self.follow >= 0]
        count = len(self.starts)
        by_start = by_member[:, self.follow >= 0]
        means = np.array([by_start[:, numbers == each].mean() for each in np.unique(numbers)])
        by_episodes = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else 0.0
        by_members = by_start.mean(axis=1).std(ddof=1) if count > 1 else 0.0
        return float(by_start.mean()), float(np.hypot(by_episodes, by_members))

    def room(self) -> Array:
        """Return what each start may cost more than with the MPC."""
        chance = self.twin.starts.chance_beyond(self.starts).ravel()
        # A start outside the log may cost .5 % more of what it costs the MPC, a rare one 5 %.
        rare = np.clip(RARE / np.maximum(chance, 1e-300), 1.0, 10.0)
        around = 0.005 * rare * np.abs(self.mpc.costs) * ~self.known
        return np.asarray(MARGIN * self.mean + around)

    def scenarios(self, rng: np.random.Generator) -> Scenarios:
        """Return the starts, in each of which another member acts; of a long log, from amid it."""
        numbers = np.arange(self.starts.shape[1])
        begins: Rows = np.zeros(len(numbers), np.intp)
        if self.steps > self.window:
            amid = rng.integers(self.steps - self.window + 1, size=len(numbers))
            begins = np.where(self.follow >= 0, amid, 0)
        return self._windows(numbers % len(self.starts), numbers, begins)

    def _windows(self, members: Rows, starts: Rows, begins: Rows) -> Scenarios:
        """Return parts of the MPC's runs, in which members act."""
        times = begins + np.arange(self.window)[:, None]
        return Scenarios(
            self.twin, members, self.rows[begins, members, starts], self.given[times, starts]
        )

    def hard(self, played: Scores) -> Scenarios | None:
        """Return the scenarios that a policy loses, or nearly, the worst first; None where none."""
        loses = (played.costs - self.mpc.costs) / np.maximum(NEARLY * self.room(), 1e-300)
        loses[np.any(less_safe(played.unsafe, self.mpc.unsafe), axis=1)] = np.inf
        worst = np.argsort(-np.nan_to_num(loses, nan=np.inf), kind="stable")
        worst = worst[~(loses[worst] <= 1)][:HARDEST]
        if not len(worst):
            return None
        members, starts = np.divmod(worst, self.starts.shape[1])
        last = np.where(self.follow[starts] >= 0, self.steps - self.window, 0)
        parts = [
            (*which, begin)
            for *which, end in zip(members, starts, last, strict=True)
            for begin in np.unique([*range(0, end, self.window), end])
        ]
        return self._windows(*np.array(parts[:HARDEST]).T)


FIRST_LOOK = 10  # pairs of a trial between rounds
LOOKS = looks(FIRST_LOOK, 80)  # pairs after which it is decided, or more are played
ENOUGH = 40  # pairs that an acceptance takes: the worst 5 % of the starts are two of them
TRIES = 3  # confirmations of a policy that is taught what it has lost


def most_episodes(rounds: int = 4) -> int:
    """Return how many episodes `improve` may play beside its first: of all rounds and tries."""
    return FIRST_LOOK * (rounds + 1) + 2 * LOOKS[-1] * (TRIES + 1)


class SimulatorTrial(PairedTrial):
    """Pairs of episodes in a simulator, one of the MPC and one of a policy, of which it learns.

    ``episodes`` are the policy's, None where one is of no use; ``played`` is what was played last,
    and from which seeds.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.episodes = list[Episode | None]()
        self.played: tuple[Trajectories, Sequence[int]] | None = None
        none = Starts((), Scores(np.empty(0), np.empty((0, 9))), Tolerance(0.0))
        super().__init__(self._play, None, none, simulator.new_seeds, self._tolerated)

    def _play(self, act: Feedback | None, seeds: Sequence[int]) -> Scores:
        controller = of_law(self.simulator.problem) if act is None else controller_of(act)
        played = self.simulator.play(controller, seeds)
        self.played = played, seeds
        if act is not None:
            self.episodes += self.simulator.learn(*self.played)
        return Scores(played.costs, played.unsafe(), np.zeros((len(played.costs), 0), dtype=bool))

    def _tolerated(self, mpc_costs: Array) -> Tolerance:
        names = BoundNames.of(self.simulator.problem)
        # A rare loss has been taught: the mean of the worst 5 % decides.
        return replace(RULE.tolerance(mpc_costs, names), worst_start=np.inf)

    def stages(self, policy: Feedback, counts: Sequence[int]) -> Iterator[int]:
        """Play a policy from ever more starts; see :class:`PairedTrial`."""
        self.episodes.clear()
        return super().stages(policy, counts)

    @property
    def less_safe(self) -> NDArray[np.bool_]:
        """Which of the policy's episodes are less safe than the MPC's."""
        return np.asarray(less_safe(self.scores.unsafe, self.mpc_scores.unsafe).any(axis=1))

    @property
    def lost(self) -> list[Episode]:
        """The policy's episodes that cost more than with the MPC, or are less safe."""
        worse = (self.relative > 0) | self.less_safe
        return [e for e, lost in zip(self.episodes, worse, strict=True) if lost and e is not None]

    def check(self, number: int, level: float, final: bool) -> tuple[Check, Verdict]:
        """Return what the pairs say of the policy, at a one-sided level of significance."""
        found = self.verdict(level, least_gain=RULE.least_gain, must_gain=True)
        mpc = self.mpc_scores.costs
        more = self.scores.costs - mpc
        gain = Difference.of(self.relative)
        mean = max(float(np.abs(mpc).mean()), 1e-300)
        of_mean = Difference.relative(more, mpc)
        room = of_mean.room(level)
        check = Check(
            number,
            found.accepted,
            found.reason,
            change=mean_change(more, mpc),
            worst=float(more.max()) / mean,
            safe=not self.less_safe.any(),
            logged=gain.mean,
            error=gain.error,
            final=final,
            interval=(of_mean.mean - room, of_mean.mean + room),
            starts=len(mpc),
            mpc_exceeds=np.count_nonzero(self.mpc_scores.unsafe[:, LARGEST_EXCESS]),
        )
        return check, found


def confirm(
    act: Feedback,
    simulator: Simulator,
    number: int,
    say: Callable[[str], None] = lambda text: None,
    significance: float = RULE.significance,
) -> tuple[Check, SimulatorTrial]:
    """Play pairs from new starts until they are decisive; return the last look, and the trial.

    Looks come after 10, 20, 40 and 80 pairs. The last two accept, and together err with a
    probability of no more than ``significance``. A policy that breaks a bound is refused at the
    first look that shows it. One that surely gains too little is so from the second on: ten starts
    may all be of those from which nothing can be gained. Where a hard bound is in force, acceptance
    takes all 80: it may be exceeded in few episodes, and that is never traded for cost. ``say`` is
    called with what each look shows.
    """
    trial = SimulatorTrial(simulator)
    level = significance / sum(count >= ENOUGH for count in LOOKS)
    for _ in trial.stages(act, LOOKS):
        found, verdict = trial.check(number, level, final=True)
        count = len(trial.starts.seeds)
        say(f"confirmation, {count} new starts: {100 * found.change:+.2f} %")
        both = np.concatenate([trial.starts.mpc.unsafe, trial.scores.unsafe])
        enough = LOOKS[-1] if both[:, LARGEST_EXCESS].any() else ENOUGH
        most = max(-found.change, 2 * found.error - found.logged)  # what it may gain
        hopeless = count > FIRST_LOOK and (verdict.is_hopeless or most < RULE.least_gain)
        refused = not found.accepted and (hopeless or not found.safe)
        if refused or (found.accepted and count >= enough):
            break
    if found.accepted and count < ENOUGH:
        few = f"{count} pairs whose costs are finite are too few"
        found = replace(found, accepted=False, reason=few)
    return found, trial
