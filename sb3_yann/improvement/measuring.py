"""What a nearly optimal controller would gain over the MPC, of what kind it is, what to do."""

from __future__ import annotations

import copy
import dataclasses
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sb3_yann._progress import Progress, say, shown
from sb3_yann._validation import Array, check_int, check_type
from sb3_yann.compare import less_safe
from sb3_yann.control import DisturbanceObserver, LinearMPC, OnlineLawWarning, offset_free
from sb3_yann.control.mpc.augmented import SHARE
from sb3_yann.env_pool import Source, maker
from sb3_yann.evaluation import change_in_percent, paired_rows, summary_lines
from sb3_yann.improvement.confirmation import most_episodes
from sb3_yann.improvement.simulator import (
    OutOfStepsError,
    Simulator,
    lacks,
    model_of,
    of_law,
    task_of,
)
from sb3_yann.plan import PAUSE, Planning, TwinPlant, value_at_end
from sb3_yann.rollout import Controller, Rows, Trajectories, require_finite
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import as_episodes
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import reidentified

LITTLE = 0.005
"""A gain below this, relative to the MPC's cost, is not worth an observer or a new model."""
WORTH = 0.02  # A gain below this is not worth learning, which finds a part of it
CURE = (
    "mpc, observer = offset_free(mpc), and env = ObserveDisturbance(env, observer, "
    "mpc.disturbances.d_min, mpc.disturbances.d_max) of sb3_yann.wrappers, within StageCost(env, "
    "mpc) of this mpc."
)
CURE_IN_TWIN = (
    "mpc, observer = offset_free(mpc), and export(mpc, path, estimator=observer), or on to "
    "improve(mpc, PlantTwin.fit(mpc, log, observer=observer))."
)
"""How an observer is added, where there is an env, and where there is a log alone."""
ADVICE = {
    "keep the MPC": f"little was found to gain over the MPC, less than {100 * WORTH:g} %. It is no "
    "bound: improve(mpc, {source}) may still find some of it, or more.",
    "add ObserveDisturbance first": "that brings {share:.0f} % of what was found: {observer}",
    "re-identify": "a linear model of the plant as it is brings {share:.0f} % of what was found: "
    "take the MPC headroom(...).reidentified.",
    "learn": "{why}: improve(mpc, {source}), or DDPG under an ImprovementGuard.",
}
UNKNOWN = "not known"
"""The verdict where what was found may be chance, or little though there may be more."""


@dataclass(frozen=True)
class Headroom:
    """What can be gained over an MPC, as :func:`headroom` has found it.

    Attributes
    ----------
    mpc_costs, observer_costs, reidentified_costs, best_costs : ndarray, shape (starts,)
        Costs of the MPC; with a disturbance observer (:func:`offset_free`); with a model that is
        re-identified from these episodes (the MPC's own where those are worse on average); of the
        best that was found.
    offset, model_error, nonlinearity : float
        Parts of the gain, relative to the MPC's mean cost: what the observer gains, which removes
        the offset of a plant that is not its model; what the re-identified model gains beyond
        that; the rest.
    verdict : str
        What to do: one of "keep the MPC", "add ObserveDisturbance first", "re-identify", "learn";
        "not known" where what was found is worth it but may be chance, and where little was found
        with plans that were made in a poor model, or not played from every start, or of episodes in
        which set-points move.
    source : str
        Where it was found.
    d_max : ndarray, shape (n,), optional
        Of :func:`offset_free`, where its default is less than the disturbances of this plant.
    lost : float, optional
        By how much plans cost more than the MPC when they were first played, relative to it, where
        the model of the env's episodes is poor, or that is no chance.
    observer_played, reidentified_played : ndarray, shape (starts,), optional
        What the MPC with an observer and the re-identified one cost when they were played, losses
        included; None where they were not.
    steps : int
        Of the env, all that were taken.
    note : str
        What was left out; empty where nothing was.
    reidentified : LinearMPC, optional
        The same MPC with a model that these episodes, or a twin's log, tell.
    budget : int
        Steps of the env that suffice `improve` for all rounds and tries; 0 in a twin.
    unplanned : int
        Starts from which no plan was played: steps were too few, or Ctrl-C came.
    why : dict of str to str
        Why "observer" or "model" were not played.

    Examples
    --------
    >>> costs = np.array([10.0, 20.0])
    >>> found = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    >>> round(found.total, 4)
    0.0333
    """

    mpc_costs: Array
    observer_costs: Array
    reidentified_costs: Array
    best_costs: Array
    offset: float
    model_error: float
    nonlinearity: float
    verdict: str
    source: str
    d_max: Array | None = None
    lost: float | None = None
    observer_played: Array | None = None
    reidentified_played: Array | None = None
    steps: int = 0
    note: str = ""
    reidentified: LinearMPC | None = None
    budget: int = 0
    unplanned: int = 0
    why: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def total(self) -> float:
        """The whole gain, relative to the MPC's mean cost."""
        return gain(self.mpc_costs, self.best_costs)

    @property
    def standard_error(self) -> float:
        """How far the total may be off because there are only so many starts."""
        spread = np.std(self.mpc_costs - self.best_costs, ddof=1) / np.sqrt(len(self.mpc_costs))
        return float(spread / (abs(self.mpc_costs.mean()) or 1.0))

    def report(self) -> str:
        """Return the figures, and what to do, in words."""
        rest = "nonlinearity and constraints" if self._rivals_played else "all the rest"
        parts = (
            (self.offset, self.observer_played, "with", "a disturbance observer"),
            (self.model_error, self.reidentified_played, "more with", "a re-identified model"),
            (self.nonlinearity, self.best_costs, "more by", rest),
        )
        of_that = [
            f"{name}: not played" if costs is None else f"{-100 * part + 0.0:+.2f} % {how} {name}"
            for part, costs, how, name in parts
        ]
        where = "twin" if self._in_twin else "env"
        steps = f"{self.steps:,} of the {where}. {self.note}".strip() if self.steps else self.note
        return summary_lines(
            f"Verdict: {self.verdict}. By its own cost, from starts of {self.source}:",
            **paired_rows(self.best_costs, self.mpc_costs),
            of_that=", ".join(of_that),
            observer=self._as_played(self.observer_played, "observer"),
            new_model=self._as_played(self.reidentified_played, "model"),
            steps=steps,
            next=self._advice(),
        )

    __str__ = report

    @property
    def _rivals_played(self) -> bool:
        return self.observer_played is not None and self.reidentified_played is not None

    @property
    def _in_twin(self) -> bool:
        return self.source == "the twin"

    def _as_played(self, costs: Array | None, name: str) -> str:
        """Return what came of another MPC, losses included."""
        if costs is None:
            return f"not played: {self.why[name]}" if name in self.why else "not played"
        each = (costs - self.mpc_costs) / np.maximum(np.abs(self.mpc_costs), 1e-300)
        more = np.count_nonzero(each > 1e-9)  # 1e-9 of an episode's cost is rounding
        return (
            f"{change_in_percent(-gain(self.mpc_costs, costs))} as it was played, worst start "
            f"{change_in_percent(each.max())} of its own cost; {more} of {len(costs)} cost more"
        )

    def _advice(self) -> str:
        """Return what the verdict means, and whether more starts might change it."""
        parts = self.offset, self.model_error, self.nonlinearity
        if self.verdict != verdict_of(*parts) != "keep the MPC":
            return "what was found may be chance on so few starts. Take more: n_starts=."
        if self.verdict == UNKNOWN and self.unplanned:
            return (
                f"nothing was found, but from {self.unplanned} of {len(self.mpc_costs)} starts no "
                "plan was played: let it end, with more max_steps= or fewer n_starts=."
            )
        poor = ""
        if self.lost is not None:
            more = "as much as" if self.lost < LITTLE / 10 else f"{100 * self.lost:.3g} % more than"
            poor = (
                "plans were made in a model of its episodes that is not the plant: when played, "
                f"they cost {more} the MPC. Take more starts: n_starts=."
            )
        source = f"make, max_steps={self.budget:_}" if self.budget else "twin"
        if self.verdict == UNKNOWN:
            if poor:
                return f"nothing was found, but {poor}"
            return f"set-points move, and no plan knows when: improve(mpc, {source}) may find more."
        observer = CURE_IN_TWIN if self._in_twin else CURE
        named = [*ADVICE].index(self.verdict)  # a new model has the observer's part too
        brought = sum(parts[:2]) if named == 2 else parts[named - 1]
        share = min(100.0, 100 * brought / (sum(parts) or 1.0))
        why = f"{share:.0f} % of it is beyond a linear model"
        if not self._rivals_played:
            why = "what a better linear model brings is not known"
        fields = {"source": source, "observer": observer, "why": why, "share": share}
        advice = ADVICE[self.verdict].format(**fields)
        if self.d_max is not None:  # the disturbances of this plant
            largest = ", ".join(f"{each:.3g}" for each in self.d_max)
            advice = advice.replace("offset_free(mpc)", f"offset_free(mpc, d_max=[{largest}])")
        played = self.observer_played
        if self.verdict == "add ObserveDisturbance first" and played is not None:
            if np.any(played > self.mpc_costs + LITTLE * np.abs(self.mpc_costs)):
                advice += " Not from every start: look at the worst one before you take it."
        return f"{advice} The rest is not known: {poor}" if poor else advice


def gain(before: Array, after: Array) -> float:
    """Return by how much mean costs fall, relative to those before."""
    return float((before.mean() - after.mean()) / (abs(before.mean()) or 1.0))


def verdict_of(offset: float, model_error: float, nonlinearity: float, doubt: float = 0.0) -> str:
    """Return what to do: a key of `ADVICE`, or `UNKNOWN` where it may be chance.

    Where the largest part is the rest, and too little to learn, an observer or a new model may be
    worth it still. Where only so many random starts are known, the whole must exceed ``doubt``.
    """
    parts = offset, model_error, nonlinearity
    verdict = [*ADVICE][1 + int(np.argmax(parts))]
    worth = WORTH if verdict == "learn" else LITTLE
    if sum(parts) < worth and max(offset, model_error) >= LITTLE:
        verdict = [*ADVICE][1 + int(np.argmax(parts[:2]))]
        worth = LITTLE
    if sum(parts) < worth or WORTH > sum(parts) < doubt:
        return "keep the MPC"
    return verdict if sum(parts) >= doubt else UNKNOWN


def headroom(
    mpc: LinearMPC,
    env_or_twin: Source | PlantTwin,
    *,
    n_starts: int = 30,
    seed: int = 0,
    max_steps: int | None = None,
    progress_bar: bool = True,
) -> Headroom:
    """Return what a nearly optimal controller would gain over an MPC, and why.

    From the same starts are played: the MPC; the MPC with a disturbance observer; an MPC whose
    model is re-identified from the MPC's episodes; and plans, optimized by differential dynamic
    programming in the model of :func:`improve`, on which feedback keeps the plant. Plans know
    neither noise nor references to come; where the plant does not do what one promised, the model
    is fitted anew. All costs are those of episodes that were played, so the gain can be had; more
    may be there to be found. None of a controller's robustness is in it.

    A plant that repeats its steps has the best controller of each start. A random one has the best
    on average, for the best of each start would be luck.

    Parameters
    ----------
    mpc : LinearMPC
        Its stage cost is what counts. A :class:`CostMismatchWarning` says where the env's own
        reward is another one.
    env_or_twin : gymnasium.Env, str, callable or PlantTwin
        A simulator that shows theta of the MPC and takes its inputs, in plant units where the MPC's
        model has an operating point. It plays the same episode again from the same seed and inputs,
        and is copied. Or a twin of the MPC's plant, whose members share the starts.
    n_starts : int, default 30
        Starts, from ``seed`` on.
    seed : int, default 0
        Of the first start.
    max_steps : int, optional
        Of the env, for everything. Where they do not suffice, the rest is left out. Ctrl-C prints
        what has been played so far.
    progress_bar : bool, default True
        Whether to show, on stderr, what takes more than three seconds and how long.

    Raises
    ------
    TypeError, ValueError
        If the env shows something else than theta, or does not repeat an episode; if a twin cannot
        be trusted; if ``max_steps`` are too few for the MPC's own episodes.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from sb3_yann import headroom
    >>> mpc = gym.make("CSTR-v0").observation_space.problem
    >>> found = headroom(mpc, "CSTR-v0", n_starts=2)
    >>> 0.01 < found.total < 0.05, found.verdict in ("learn", "keep the MPC")
    (True, False)
    """
    check_type("mpc", mpc, LinearMPC, "a LinearMPC")
    check_int("n_starts", n_starts, 2)
    check_int("seed", seed, 0)
    if max_steps is not None:
        check_int("max_steps", max_steps)
    search = _Search(mpc, env_or_twin, range(seed, seed + n_starts), max_steps)
    with shown(progress_bar, parts=True), threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", OnlineLawWarning)
        return search.run()


class _Search:
    """What is played, one controller after the other."""

    def __init__(
        self, mpc: LinearMPC, given: Source | PlantTwin, seeds: range, max_steps: int | None
    ) -> None:
        self.mpc = mpc
        self.seeds = seeds
        self.twin = given if isinstance(given, PlantTwin) else None
        if self.twin is not None:
            self.twin.require_trust()
            other = self.twin.problem
            same = np.array_equal(other.deviations.u_min, mpc.deviations.u_min)
            if other.layout != mpc.layout or not same:
                raise ValueError(
                    "The twin is that of another MPC's plant: fit it with PlantTwin.fit(mpc, "
                    "episodes)."
                )
        source = given.env if isinstance(given, PlantTwin) else maker(given)
        self.simulator = Simulator(mpc, source, seeds[0], max_steps)
        self.progress = Progress(lambda: self.simulator.steps)
        self.source = "the twin" if self.twin is not None else self.simulator.name
        self.random = self.poor = False
        self.law: Controller = of_law(mpc)  # the better one, of the MPC and with another model
        self.played: dict[str, Array] = {}  # costs of each controller, losses included
        self.fair: dict[str, Array] = {}  # the MPC's where a bound is broken by more
        self.found: dict[str, Any] = {}  # of the result: what is known of the rivals
        self.why: dict[str, str] = {}
        self.planned = np.zeros(len(seeds), dtype=bool)  # starts from which a plan was played

    def run(self) -> Headroom:
        """Play all of it, and return the figures."""
        note = ""
        try:
            value_at_end(self.mpc)  # raises where the law cannot rest: no plan could be made
            self.play_mpc()
            for stage in (self.observe, self.reidentify, self.plan):
                stage()
        except OutOfStepsError:
            if not hasattr(self, "base"):
                raise ValueError(
                    f"max_steps = {self.simulator.max_steps:,} are too few for "
                    f"{len(self.seeds)} episodes of the MPC. Where these have no end, wrap the env "
                    "in a TimeLimit."
                ) from None
            note = f"max_steps = {self.simulator.max_steps:,} were too few to go on."
        except KeyboardInterrupt:
            if hasattr(self, "base"):
                say("Interrupted; of what was played so far:", sys.stderr)
                say(self.figures(""), sys.stderr)
            raise
        finally:
            self.simulator.close()
        return self.figures(note)

    def say(self, text: str, left: float = 0.0) -> None:
        """Write a line with the gain that was found."""
        gained = f"{0.0 - 100 * gain(self.base.costs, self.best):+.2f} %"
        whose = "the best so far" if self.random else "the best of each start so far"
        self.progress(f"{text}; {whose}: {gained}", left)

    @property
    def best(self) -> Array:
        """Costs of the best controller of each start, or on average where the plant is random."""
        every = [self.base.costs, *self.fair.values()]
        return min(every, key=np.mean) if self.random else np.min(every, axis=0)

    def add(self, name: str, loops: Trajectories) -> None:
        """Take what was played from all starts into account."""
        self.played[name] = loops.costs
        self.fair[name] = np.where(loops.no_worse(self.base), loops.costs, self.base.costs)
        self.simulator.learn(loops, self.seeds)

    def play_mpc(self) -> None:
        """Play the MPC, and see that the env repeats an episode."""
        played = self.simulator.watch(self.seeds, checked=self.twin is None)
        require_finite("the env", self.seeds, played.costs)
        self.base = played
        self.simulator.learn(played, self.seeds)
        if self.twin is None:
            self.simulator.require_episodes()
        self.say(f"{len(self.seeds)} episodes of the MPC")

    def observe(self) -> None:
        """Play the same MPC with an observer, unless it has one."""
        mpc = self.mpc
        thetas, inputs, following = self.base.steps()
        beyond = np.abs(following - mpc.deviations.predict(thetas, inputs)).max(axis=0)
        unit = mpc.theta_half[mpc.layout.state]
        try:
            largest = np.maximum(2 * beyond[mpc.layout.state], 1e-6 * unit)
            pair = offset_free(mpc, largest)
        except ValueError as error:  # a disturbance that no input can hold
            self.why["observer"] = str(error)
            return
        if np.any(largest > SHARE * unit):  # the default would cut off what was found here
            self.found["d_max"] = np.maximum(largest, SHARE * unit)
        self.add("observer", self.simulator.play(Observing(mpc, *pair), self.seeds))
        self.say("the MPC with a disturbance observer")

    def reidentify(self) -> None:
        """Play the MPC with a model that its own episodes, or the twin's log, tell."""
        try:
            if self.twin is not None:
                other = self.twin.reidentified()
            else:
                log = as_episodes(self.mpc.deviations, self.base.pairs)
                other = reidentified(self.mpc, Coordinates.of(RowLayout(self.mpc), log), log)
        except ValueError as error:  # a model without a steady state or a Riccati solution
            self.why["model"] = str(error)
            return
        self.why["model"] = "these episodes tell no other one"
        if other is not self.mpc:
            self.found["reidentified"] = other
            law = of_model(self.mpc, other)
            self.add("model", self.simulator.play(law, self.seeds))
            if self.fair["model"].mean() < self.base.costs.mean():
                self.law = law
            self.say("the MPC with a re-identified model")

    def plan(self) -> None:
        """Play plans: those of a twin, or of a model that learns from what was played."""
        rounds = 4  # how often a model is fitted and planned in, at most
        base = self.base
        simulator = self.simulator
        unit = max(float(np.abs(base.costs).sum() / base.lengths.sum()), 1e-300)
        if self.twin is not None:
            dynamics = self.twin.dynamics
            acting = TwinPlant(dynamics, [seed % len(dynamics.members) for seed in self.seeds])
            self.add("plan", simulator.play(self._planning(self.twin, acting, unit), self.seeds))
            self.planned[:] = True
            self.say("plans in the twin")
            return
        some = max(simulator.usual // 2, simulator.usual - len(base.costs))
        simulator.excite(some)
        self.say(f"{some} episodes with random inputs")
        todo: NDArray[np.intp] = np.arange(len(base.costs))
        latest = base.costs.copy()
        for number in range(rounds):
            began = time.monotonic()
            now = todo[: simulator.affordable()]
            if not len(now):
                raise OutOfStepsError
            model = model_of(self.mpc, simulator.episodes, simulator.row.estimator, number)
            self.random, self.poor = lacks(model)
            planning = self._planning(model, TwinPlant(model.dynamics), unit)
            seeds = [self.seeds[i] for i in now]
            loops = simulator.play(planning, seeds, strict=False)
            self.planned[now] = True
            if number == 0 and len(now) == len(todo):
                self.played["plan"] = loops.costs
            safe = ~less_safe(loops.unsafe(), base.unsafe()[now]).any(axis=1)
            latest[now] = np.where(safe, loops.costs, base.costs[now])
            self.fair[f"plan {number}"] = latest.copy()
            simulator.learn(loops, seeds)
            costlier = loops.costs - planning.promised(len(now))
            # Anew where the plant broke a plan's promise by .1 % of the MPC's mean cost.
            kept = safe & (costlier <= 1e-3 * np.abs(base.costs).mean())
            todo = np.setdiff1d(todo, now[kept])
            self.say(
                f"plans, round {number + 1} of at most {rounds}: {kept.sum()} of {len(now)} kept "
                "what they promised",
                (rounds - 1 - number) * (time.monotonic() - began) * bool(len(todo)),
            )
            if not len(todo) or (number and self.random and not self.poor):  # noise is not learnt
                break

    def _planning(self, model: Any, plant: TwinPlant, unit: float) -> Planning:
        pause = PAUSE if self.simulator.row.observer is not None else 0
        task = task_of(model, unit, priced=self.twin is None)
        steps = int(self.base.lengths.max())
        rows = np.empty(0, dtype=np.intp)
        if not self.random:
            return Planning(plant, task, steps, pause)
        # 0.05: half-widths from its plan at which an MPC has a random plant again: see `Planning`
        return Planning(plant, task, steps, pause, 0.05, lambda theta: self.law(0, theta, rows))

    def figures(self, note: str) -> Headroom:
        """Return the figures."""
        sure = 2.0  # standard errors that a gain on a random plant must exceed
        base = self.base.costs
        if ended := int(self.base.terminated.sum()):
            which = f"{ended} of {len(base)} episodes of the MPC are ended by the env"
            note = f"{which}: their costs are those of fewer steps. {note}".strip()
        excess = self.base.excess
        assert excess is not None
        if beyond := np.count_nonzero(excess.largest):
            note += f" The MPC exceeds a hard bound in {beyond} of {len(base)} episodes."
        if paid := np.count_nonzero(excess.penalty):
            share = 100 * float(np.mean(excess.penalty) / (abs(np.mean(base)) or 1.0))
            some = f"of the MPC's cost is for soft bounds, from {paid} of {len(base)} starts"
            note += f" {share:.2g} % {some}."
        # The MPC's own where another one is not better on average.
        both = (self.fair.get(name, base) for name in ("observer", "model"))
        observer, model = (each if each.mean() < base.mean() else base for each in both)
        best = self.best
        total = gain(base, best)
        offset, known = (min(gain(base, each), total) for each in (observer, model))
        parts = offset, max(0.0, known - offset), total - max(offset, known)
        whole = Headroom(base, observer, model, best, *parts, "", self.source, **self.found)
        verdict = verdict_of(*parts, doubt=sure * whole.standard_error * self.random)
        if verdict == [*ADVICE][1]:  # where it loses from some starts, others may bring less
            if not offset > sure * dataclasses.replace(whole, best_costs=observer).standard_error:
                verdict = UNKNOWN
        more = self.played.get("plan", base) - base
        lost = float(more.mean() / (abs(base.mean()) or 1.0)) if self.twin is None else 0.0
        if not self.poor and more.mean() < sure * np.std(more, ddof=1) / np.sqrt(len(more)):
            lost = 0.0  # it may be noise
        unplanned = int(np.count_nonzero(~self.planned))
        thetas, _, following = self.base.steps()
        moving = np.any((following - thetas)[:, self.mpc.layout.reference])
        part = moving and not self.random and total >= LITTLE / 10
        if (lost > 0 or unplanned or part) and verdict_of(*parts) == "keep the MPC":
            verdict = UNKNOWN
        return dataclasses.replace(
            whole,
            verdict=verdict,
            lost=lost if lost > 0 else None,
            observer_played=self.played.get("observer"),
            reidentified_played=self.played.get("model"),
            steps=self.simulator.steps,
            note=note.strip(),
            budget=self.simulator.needed(most_episodes()) if self.twin is None else 0,
            unplanned=unplanned,
            why=self.why,
        )


def of_model(problem: LinearMPC, other: LinearMPC) -> Controller:
    """Return an MPC with another model and operating point, as a law of the problem's theta."""
    law = other.online()
    own = problem.units
    its = other.units
    limits = problem.deviations.u_min, problem.deviations.u_max

    def act(t: int, theta: Array, rows: Rows) -> Array:
        u = law(its.to_deviations(own.to_plant(np.nan_to_num(theta))))
        return np.clip(own.input_to_deviations(its.input_to_plant(u)), *limits)

    return act


@dataclass
class Observing:
    """The offset-free MPC with an observer for each episode; the env shows theta of the problem."""

    problem: LinearMPC
    other: LinearMPC
    observer: DisturbanceObserver
    remembers = True

    def __call__(self, t: int, theta: Array, rows: Rows) -> Array:
        """Return the inputs (r, m)."""
        layout = self.problem.layout
        bounds = self.other.deviations.disturbances
        x = theta[:, layout.state]
        k = layout.n_disturbances  # of this sample; behind them stands the preview
        measured = theta[:, layout.disturbance]
        if t == 0:
            self.observers = [copy.copy(self.observer) for _ in x]
            self.u = np.zeros((len(x), self.other.model.n_inputs))
            self.loads = measured.copy()  # disturbances, measured or to come, as u acted
            found = [each.reset(y) for each, y in zip(self.observers, x, strict=True)]
        else:
            found = [
                self.observers[i].update(y, self.u[i], self.loads[i, :k] if k else None)
                for i, y in zip(rows, x, strict=True)
            ]
        self.loads[rows] = measured
        x_hat, d_hat = (np.array(each) for each in zip(*found, strict=True))
        d = np.hstack([measured, np.clip(d_hat, bounds.d_min[k:], bounds.d_max[k:])])
        rest = theta[:, layout.limits], theta[:, layout.previous]
        parts = x_hat, theta[:, layout.reference], d, *rest
        self.u[rows] = self.other.online()(np.concatenate(parts, axis=1))
        return self.u[rows]
