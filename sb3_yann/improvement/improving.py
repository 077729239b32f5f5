"""A better policy from a twin or a simulator: plans in a learnt model, imitated, then confirmed."""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from threadpoolctl import threadpool_limits

from sb3_yann._progress import Progress, say, shown
from sb3_yann._validation import check_bool, check_int
from sb3_yann.compare import RULE, TOO_LITTLE
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.linear_system import missing_observer
from sb3_yann.deployment.exporting import Exported, export
from sb3_yann.env_pool import Source, maker
from sb3_yann.evaluation import change_in_percent, summary_lines
from sb3_yann.improvement.confirmation import (
    ENOUGH,
    FIRST_LOOK,
    LOOKS,
    TRIES,
    Check,
    SimulatorTrial,
    Trial,
    confirm,
    most_episodes,
)
from sb3_yann.improvement.imitation import Teacher, controller_of, imitate, policy_of, refit_critic
from sb3_yann.improvement.simulator import (
    Excited,
    Family,
    OutOfStepsError,
    Scenarios,
    Simulator,
    model_of,
    one_step_error,
)
from sb3_yann.networks.yann import LawLayer
from sb3_yann.plan import value_at_end
from sb3_yann.policy.checkpoint import all_or_nothing, fingerprint
from sb3_yann.policy.observations import AffineObservation
from sb3_yann.policy.policies import (
    StartsAsMPC,
    YannPolicy,
    require_problem_of_twin,
    require_yann_policy,
)
from sb3_yann.rollout import preserve_rng
from sb3_yann.twin.env import LearntModel
from sb3_yann.twin.log import Episode
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.units import FLOAT32_ROUNDING

RETREATS = (0.5, 0.25)  # shares of a correction that are tried where all of it is refused
PROMISED = 0.95  # share of a gain in the model that the simulator must show from the same starts


def of_estimates(problem: LinearMPC) -> str:
    """Return what costs and bounds are of where an estimator stands between, in a sentence."""
    estimates = missing_observer(problem.model)
    return " Costs and bounds are those of the estimates, not of the plant." * bool(estimates)


@dataclass(frozen=True)
class Improvement:
    """What :func:`improve` did; it travels in the model's zip, in ``model.improvements``.

    Attributes
    ----------
    checks : tuple of Check
        The comparisons of candidates with the MPC, in the twin or in the simulator.
    change : float
        The accepted policy's mean cost there against the MPC's: -0.02 is 2 % less, 0 without one.
    accepted : bool
        Whether a policy passed. If none did, the model is as it was.
    before : Check, optional
        Of what the model had learnt before, if it had.
    where : {"the twin", "the simulator"}
    source : str
        Which twin or simulator.
    episodes : int
        Of the log that the twin was fitted to, or played in the simulator.
    steps : int
        Taken in the simulator, all of them.
    settings : dict of str to number
        The arguments.
    policy : str
        Fingerprint of the policy's weights when it ended.
    model : BaseAlgorithm, optional
        With the policy; not in the model's zip.
    estimator : StateEstimator, optional
        What the policy's estimates came from; nor is it in that zip.
    note : str
        What ended the search before a final check; empty where nothing did.

    Examples
    --------
    >>> Improvement(checks=(), change=-0.02, accepted=True).reason
    ''
    """

    checks: tuple[Check, ...]
    change: float
    accepted: bool
    before: Check | None = None
    where: str = "the twin"
    source: str = ""
    episodes: int = 0
    steps: int = 0
    settings: dict[str, float] = field(default_factory=dict)
    policy: str = ""
    model: Any = field(default=None, repr=False, compare=False)
    estimator: StateEstimator | None = field(default=None, repr=False, compare=False)
    note: str = ""

    @property
    def interval(self) -> tuple[float, float]:
        """Where ``change`` lies with 90 %: in the simulator, or on a twin's plant.

        Ends are fractions of the MPC's mean cost: -0.02 is 2 % less. Both are 0 where nothing was
        accepted; what was refused has its own in ``checks``.
        """
        if not self.accepted:
            return 0.0, 0.0
        last = self._accepted
        return (last and last.interval) or (-np.inf, np.inf)

    def export(self, path: str | PathLike[str], **options: Any) -> Exported:
        """Write policy and estimator as a file or as code: :func:`sb3_yann.export` of the model."""
        return export(self.model, path, **{"estimator": self.estimator} | options)

    @property
    def reason(self) -> str:
        """Why nothing was accepted; empty where something was."""
        if self.accepted:
            return ""
        last = self._last
        text = f"no gain in {self.where}"
        if last:
            little = f"{change_in_percent(last.change)} in {self.where} is too little, or not sure"
            text = last.reason or little
        return f"Nothing better was found: {self.note or text}."

    @property
    def _last(self) -> Check | None:
        """The candidate that decided: the last one, of those that were confirmed if any was."""
        tried = [each for each in self.checks if each is not self.before]
        decided = [each for each in tried if each.final] or tried
        return decided[-1] if decided else None

    def report(self) -> str:
        """Return in words what was accepted, or why nothing was, what it took, and what next."""
        tried = f"{len(self.checks)} candidate{'s' * (len(self.checks) != 1)} tried"
        steps = f"{self.steps:,} of the simulator, {tried}" if self.steps else tried
        source = "twin" if self.where == "the twin" else "env"
        if not self.accepted:
            text = f"{self.reason} The model is as it was."
            last = self._last
            refused = f"the last candidate, {self._change(last.change, last)}" if last else ""
            refused += f": {last.reason}" if last and last.reason and self.note else ""
            most = min((each.change for each in self.checks), default=0.0)
            if last and most < last.change:
                refused += f"; of another one it was {change_in_percent(most)}"
            return summary_lines(text, refused=refused, steps=steps, next=self._next())
        last = self._accepted
        rows = {"change": self.change_in_words}
        if last is not None:
            rows["worst_start"] = f"{change_in_percent(last.worst)} of the MPC's mean cost"
            rows["worst_start"] += " in the twin: the plant's may be worse" * (source == "twin")
            rows["violations"] = "no more than the MPC's" if last.safe else "more than the MPC's"
            if last.mpc_exceeds:
                rows["violations"] += f"; that exceeds a hard bound from {last.mpc_exceeds} starts"
                rows["violations"] += ": give the MPC tighter ones"
        more = f'report(result.model, "report.html", {source}={source}), result.model.save(path), '
        more += "then Commissioning(result.model, plant, shadow=True), which begins with the MPC"
        text = "Accepted: a better policy."
        if self.model is not None:
            text += of_estimates(self.model.policy.problem)
        return summary_lines(text, **rows, steps=steps, next=more)

    @property
    def _accepted(self) -> Check | None:
        return next((each for each in reversed(self.checks) if each.accepted), None)

    @property
    def change_in_words(self) -> str:
        """The change of what was accepted, with its interval: in the simulator, or on the plant."""
        return self._change(self.change, self._accepted)

    def _change(self, change: float, check: Check | None) -> str:
        """Return a change with the interval of its check: in the simulator, or on the plant."""
        interval = None if check is None else check.interval
        cost = "of the MPC's mean cost"
        if self.where == "the twin":
            found = f"{change_in_percent(change)} {cost} in the twin, from starts like the log's"
            if interval is None:
                return found
            low, high = (100 * each for each in interval)
            return f"{found}; on the plant {low:+.2f} to {high:+.2f} % (90 %)"
        found = f"{change_in_percent(change, interval)} {cost} in the simulator"
        return found + (f", from {check.starts_in_words}" if check and check.starts else "")

    def _next(self) -> str:
        """Return what leads on after a refusal."""
        _, settled, cure = self.reason.rstrip(".").partition("to settle it, ")
        if settled:
            return f"keep the MPC and {cure.partition(';')[0]}; then fit the twin anew"
        if "too little to teach" in self.reason:
            source = "twin" if self.where == "the twin" else "env"
            return (
                "keep the MPC: plans gain little over it. Whether an observer or a new model does, "
                f"headroom(mpc, {source}) says"
            )
        if "Ctrl-C" in self.note:
            return "keep the MPC, or start again"
        if "max_steps" in self.note:
            end = "end episodes by a TimeLimit, " * ("TimeLimit" in self.note)
            return f"{end}give more max_steps, or keep the MPC"
        if self.where == "the twin":
            tracks = self.model is None or self.model.policy.problem.layout.n_references
            other = "starts and set-points" if tracks else "starts"
            return f"keep the MPC; log more episodes, of other {other}, and fit anew"
        more = [f"{k}={2 * v}" for k, v in self.settings.items() if k in ("n_starts", "updates")]
        return f"keep the MPC, or learn from more: improve(..., {', '.join(more)})"

    __str__ = report


def improve(
    model: BaseAlgorithm | LinearMPC,
    twin: PlantTwin | Source | VecEnv,
    *,
    max_steps: int | None = None,
    n_starts: int = 40,
    rounds: int = 4,
    updates: int = 4000,
    confine: bool = True,
    seed: int = 0,
    progress_bar: bool = True,
) -> Improvement:
    """Improve a model's policy in a twin of its plant, or with a simulator; the plant sees nothing.

    Nearly optimal plans, those of :func:`headroom`, are made in a learnt model, and the actor's
    networks learn to do what they do. A simulator decides by new starts, in pairs with the MPC; a
    twin by every member, and by :meth:`PlantTwin.forecast`: ``docs/improve.md`` has the steps and
    the tests.

    Where the actor keeps the problem's bounds, and no ``bounds_margin`` was given, it keeps as far
    from them as the MPC's model errs in 95 % of the steps. The model ends with the policy that was
    accepted and a critic that is refitted to it, else as it was. It saves and goes on learning as
    any other. One that a twin taught has the twin's spaces: its file is loaded for another env by
    ``DDPG.load(path, env=env, custom_objects={"observation_space": env.observation_space,
    "action_space": env.action_space})``. Ctrl-C prints what was found so far, and leaves the model
    as it was.

    Parameters
    ----------
    model : DDPG, TD3, SAC, TQC, PPO or LinearMPC
        With a YANN policy of the twin's problem; the most likely actions of the last three are
        improved, and their spread stays. An MPC gets a DDPG model of its own, with one network for
        all regions: ``result.model``, ``result.export("controller.c")``.
    twin : PlantTwin, gymnasium.Env, str, callable or VecEnv
        A twin, which must be trusted; or a simulator, which shows theta of the model's problem, in
        plant units where that is, or what the policy's ``observation`` makes theta of. The
        problem's stage cost counts, and no reward: a :class:`CostMismatchWarning` says where that
        is another one. A function or an id makes as many as are played side by side, a given env
        is copied, a VecEnv is not: in the model's own, `learn` begins new episodes afterwards. The
        processes of a SubprocVecEnv play at once. Within
        ``joblib.parallel_config("loky", n_jobs=2)``, or ``"dask"``, workers share the episodes.
    max_steps : int, optional
        Of a simulator, for everything. Where they do not suffice nothing is accepted; where they
        cannot, it ends after one episode. The result names how many are needed.
    n_starts : int, default 40
        Episodes that are planned in the model; in a twin, also starts of a check for each member,
        so many as the log begins, and as many around.
    rounds : int, default 4
        How often a model is fitted and planned in, at most; in a twin, how often a policy is taught
        what a check refuses.
    updates : int, default 4000
        Steps of Adam of a fit of the actor to plans.
    confine : bool, default True
        Whether the MPC acts alone beyond what the log, or the simulator's episodes, show: see
        :meth:`YannPolicy.confine_correction`.
    seed : int, default 0
        Of the starts, the models and the batches. No other random numbers are drawn.
    progress_bar : bool, default True
        Whether to show, on stderr, what takes more than three seconds and how long.

    Raises
    ------
    UntrustedTwinError
        If the twin is not to be trusted: the model stays as it is.
    TypeError, ValueError
        If the model has no YannPolicy, or another problem than the twin or the simulator.

    Examples
    --------
    >>> from sb3_yann import PlantTwin, improve
    >>> from sb3_yann.evaluation import evaluate
    >>> from sb3_yann_envs import problems
    >>> mpc = problems.cstr()
    >>> log = evaluate(mpc.explicit(), "CSTR-v0", seeds=range(5))  # a plant's own episodes
    >>> twin = PlantTwin.fit(mpc, [*zip(log.observations, log.actions)], residuals=["quadratic"])
    >>> found = improve(mpc, twin, rounds=1, n_starts=8, updates=200)  # a glance
    >>> found.change <= 0, found.model.policy.problem is mpc
    (True, True)

    ``improve(mpc, "CSTR-v0")`` does it with the simulator.
    """
    given = dict(locals())
    if not isinstance(model, BaseAlgorithm | LinearMPC):
        raise TypeError(f"model = {model!r} must be a model with a YannPolicy, or a LinearMPC.")
    if not (isinstance(twin, PlantTwin | str | gym.Env | VecEnv) or callable(twin)):
        raise TypeError(
            f"twin = {twin!r} must be a PlantTwin; or a simulator: a single gymnasium.Env, its id, "
            "or a function that makes one, or a VecEnv of them."
        )
    for name, least in {"n_starts": 1, "rounds": 1, "updates": 1, "seed": 0}.items():
        check_int(name, given[name], least)
    if max_steps is not None:
        check_int("max_steps", max_steps)
        if isinstance(twin, PlantTwin):
            raise ValueError(
                f"max_steps = {max_steps} bounds the steps of a simulator, and a twin takes none. "
                "Leave it out; n_starts, rounds and updates bound what a twin takes."
            )
    check_bool("confine", confine)
    with shown(progress_bar, parts=True), threadpool_limits(1):
        if isinstance(model, LinearMPC):
            with preserve_rng():  # a seed of Stable-Baselines3 is a global one
                model = DDPG(
                    YannPolicy,
                    twin.env() if isinstance(twin, PlantTwin) else maker(twin)(),
                    gamma=min(model.gamma, 0.99),
                    seed=seed,
                    device="cpu",
                    policy_kwargs={"problem": model, "networks": "shared"},
                )
        policy = require_yann_policy(model.policy, "improve")
        if isinstance(twin, PlantTwin):
            require_problem_of_twin(policy, twin.problem)
            twin.require_trust()
        own = model.get_env()
        if isinstance(twin, VecEnv) and own is not None and own.unwrapped is twin.unwrapped:
            model._last_obs = None  # the episodes under way are cut off: `learn` begins others
        work = _Work(policy, n_starts, rounds, updates, seed, _Progress(rounds), confine)
        try:
            if isinstance(twin, PlantTwin):
                work.confine_to(twin)
                found = work.in_twin(twin)
                found = replace(found, source=repr(twin), episodes=len(twin.episodes))
            else:
                # A simulator is not the env that VecNormalize normalizes.
                seen = None if model.get_vec_normalize_env() else policy.observation
                found = work.with_simulator(twin, max_steps, seen)
        except KeyboardInterrupt:
            found = Improvement(tuple(work.checks), 0.0, False, note="Ctrl-C ended the search")
            if simulator := work.say.simulator:
                found = replace(found, where="the simulator", steps=simulator.steps)
                uncounted = ", and what its workers were playing is not counted" * simulator.shares
                found = replace(found, note=found.note + uncounted)
            say(found, sys.stderr)
            raise
    names = "max_steps", "n_starts", "rounds", "updates", "confine", "seed"
    settings = {name: given[name] for name in names if given[name] is not None}
    found = replace(found, settings=settings, policy=fingerprint(policy.actor))
    record: Any = model
    record.improvements = (*getattr(model, "improvements", ()), found)
    return replace(found, model=model, estimator=work.estimator)


@dataclass
class _Progress:
    """Lines that say what is done, and about how long the rest takes.

    So many ``rounds`` and ``confirmations`` are left at most.
    """

    rounds: int
    confirmations: int = 0
    simulator: Simulator | None = None

    def __post_init__(self) -> None:
        self.write = Progress()
        self.ends = list[float]()  # when the data were there, and when each round was over

    def __call__(self, text: str, detail: bool = False) -> None:
        """Write a line. Changes are of the cost."""
        left = 0.0
        if len(self.ends) > 1:
            each = (self.ends[-1] - self.ends[0]) / (len(self.ends) - 1)
            left = max(each * self.rounds - (time.monotonic() - self.ends[-1]), 0.0)
            if self.simulator:
                episodes = 2 * self.confirmations * LOOKS[-1]
                left += self.simulator.seconds * episodes / max(self.simulator.played, 1)
        self.write(text, left, detail)

    def begin(self, simulator: Simulator) -> None:
        """Count the steps of a simulator."""
        self.simulator = simulator
        self.write.steps = lambda: simulator.steps
        self.rounds += TRIES - 1
        self.confirmations = TRIES + 1

    def end_of_round(self) -> None:
        """Note the time, from which what is left follows."""
        self.rounds -= bool(self.ends)
        self.ends.append(time.monotonic())


@dataclass
class _Work:
    """The search for a better actor: a copy of a policy's layer, given back if it passes."""

    policy: StartsAsMPC
    n_starts: int
    rounds: int
    updates: int
    seed: int
    say: _Progress
    confine: bool = True

    def __post_init__(self) -> None:
        self.problem = self.policy.problem
        self.layer: LawLayer = copy.deepcopy(self.policy.actor.mu).cpu()
        self.rng = np.random.default_rng([self.seed, 1])
        self.checks: list[Check] = []
        self.hard: Scenarios | None = None  # what the last check in a twin has lost
        self.is_family = False  # the first model of a simulator
        self.estimator: StateEstimator | None = None  # what the policy's estimates come from

    def act(self) -> Any:
        """Return the layer as it is now as a policy."""
        return policy_of(self.layer, self.problem)

    def scale(self, share: float, weights: Mapping[str, th.Tensor]) -> None:
        """Give the layer a share of a correction."""
        last = [key for key in weights if key.startswith("network.rest.")][-1]
        self.layer.load_state_dict({**weights, last: share * weights[last]})

    def accept(self, model: LearntModel) -> None:
        """Give the policy the layer as it is, and a critic that knows it."""
        policy = self.policy
        with all_or_nothing(policy):
            policy.actor.mu.load_state_dict(self.layer.state_dict())
            policy.actor_target.load_state_dict(policy.actor.state_dict())
            for network in (policy.actor, policy.critic):
                network.optimizer.state.clear()  # what other weights were moved by
            refit_critic(policy, model, self.seed)
        margin = float(self.layer.margin)
        if policy.keep_bounds and margin != policy.bounds_margin:
            policy.set_bounds_margin(margin)

    def keep_margin(self, row: RowLayout, episodes: Sequence[Episode]) -> None:
        """Let the layer keep as far from bounds as the MPC's model errs, if no margin was given."""
        if len(self.layer.rows) and float(self.layer.margin) == 0:
            error = one_step_error(row, episodes)
            self.layer.keep(error if error > FLOAT32_ROUNDING else 0.0)

    def confine_to(self, model: LearntModel) -> None:
        """Let the layer's networks count only where a model's episodes were, if they are to."""
        self.layer.confine(*(model.starts.shown if self.confine else (None, None)))

    def in_twin(self, twin: PlantTwin) -> Improvement:
        """Plan in the members of a twin, imitate, and check on every member."""
        self.estimator = twin.dynamics.row.estimator
        self.keep_margin(twin.dynamics.row, twin.episodes)
        trial = Trial.draw(twin, self.n_starts, self.rng)
        before = None if self.layer.network.is_zero() else self._check_in(trial)
        best = before.change if before is not None and before.accepted else 0.0

        def passes(share: float) -> bool:
            found = self._check_in(trial, share)
            return found.accepted and found.logged <= -RULE.least_gain and found.change < best

        def improvement(accepted: bool, note: str = "") -> Improvement:
            if accepted:
                self.accept(twin)
            change = self.checks[-1].logged if accepted else 0.0
            return Improvement(tuple(self.checks), change, accepted, before, note=note)

        # As many as are asked for, half of them as the log begins, half around.
        drawn = Trial.draw(twin, -(-self.n_starts // 2), self.rng)
        scenarios: Scenarios | None = drawn.scenarios(self.rng)
        episodes: list[Episode] = []
        shown: Teacher | None = None
        self.say.end_of_round()
        for number in range(self.rounds):
            if scenarios is None:
                break
            self.say(f"round {number + 1} of at most {self.rounds}: {len(scenarios)} plans")
            if twin.dynamics.row.hidden:
                scenarios = self._of_estimates(scenarios, episodes, self.seed + number)
            teacher = Teacher(scenarios, self.seed + number)
            teacher.show()
            plans = f"plans {change_in_percent(-teacher.gain)}"
            if shown is None and not teacher.gain > RULE.least_gain / 10:
                return improvement(False, f"{plans} in the twin, too little to teach")
            if shown is not None:
                teacher.earlier = [*shown.earlier, *shown.taught.values()]
            gained = imitate(self.layer, teacher, self.updates, partial(self.say, detail=True))
            shown = teacher
            self.say.end_of_round()
            self.say(
                f"round {number + 1} of at most {self.rounds}, from the plans' starts in the twin: "
                f"policy {change_in_percent(-gained)}, {plans}"
            )
            if passes(1.0):
                return improvement(True)
            scenarios = self.hard
        whole = copy.deepcopy(self.layer.state_dict())
        for share in RETREATS:
            self.scale(share, whole)
            if passes(share):
                return improvement(True)
        return improvement(False)

    def _of_estimates(self, scenarios: Scenarios, episodes: list[Episode], seed: int) -> Scenarios:
        """Return scenarios of a twin of hidden states in a model of what the policy sees.

        It is fitted to what comes of them in the twin, by the policy and with inputs moved at
        random, and to all that came before.
        """
        row = scenarios.model.dynamics.row
        for controller in (controller_of(self.act()), Excited(self.problem, seed)):
            played = scenarios.play(controller)
            pairs = zip(played.thetas.swapaxes(0, 1), played.inputs.swapaxes(0, 1), strict=True)
            episodes += [Episode(*each) for each in pairs if np.isfinite(each[0]).all()]
        model = model_of(self.problem, episodes, row.estimator, seed)
        return Scenarios(model, None, row.shown(scenarios.starts), scenarios.given)

    def _check_in(self, trial: Trial, share: float = 1.0) -> Check:
        """Check the layer on the known starts of a twin, then on new ones, and by other models."""
        act = self.act()
        number = len(self.checks) + 1
        played = trial.play(act)
        found = trial.check(number, played)
        self.hard = trial.hard(played)
        if found.accepted:
            new = Trial.draw(trial.twin, self.n_starts, self.rng)
            played = new.play(act)
            confirmed = new.check(number, played)
            self.hard = new.hard(played)
            if not confirmed.accepted:
                found = replace(confirmed, reason=f"on new starts, {confirmed.reason}")
            else:
                worst = max(found.worst, confirmed.worst)
                found = self._forecast(trial.twin, replace(found, worst=worst))
        how = f"{share:.0%} of the correction, {trial.n_known} starts like the log's in each member"
        self.note(found, how, found.verdict)
        return found

    def note(self, found: Check, how: str, verdict: str) -> None:
        """Keep a candidate's check, and write a line with its number."""
        self.checks.append(found)
        change = change_in_percent(found.change)
        self.say(f"candidate {len(self.checks)}, {how}: {change}, {verdict}")

    def _forecast(self, twin: PlantTwin, check: Check) -> Check:
        """Return a check with what the layer changes on the plant; it must surely gain."""
        self.say.write(f"its change on the plant, by {len(twin.judges)} models of the log")
        change, low, high, cure, worst, objection = twin.forecast(self.act())
        found = replace(check, logged=change, error=(high - low) / 2, interval=(low, high))
        found = replace(found, worst=max(check.worst, worst))
        if high < 0:
            reason = f"from new starts, {objection}" if objection else ""
            return replace(found, accepted=not objection, reason=reason)
        text = f"on the plant it may change the cost by {100 * low:+.2g} to {100 * high:+.2g} %"
        little = max(-low, high) < RULE.least_gain
        leads_on = "too little to teach" if little else f"to settle it, {cure}"
        return replace(found, accepted=False, reason=f"{text}: {leads_on}")

    def with_simulator(
        self, env: Source | VecEnv, max_steps: int | None, seen: AffineObservation | None
    ) -> Improvement:
        """Learn a model of a simulator, plan in it, imitate, and let the simulator decide.

        ``seen`` makes theta of what it shows.
        """
        simulator = Simulator(self.problem, env, self.seed, max_steps, seen)
        self.say.begin(simulator)
        before: Check | None = None
        note = ""
        accepted = False
        least = 2 * (FIRST_LOOK + ENOUGH)  # episodes beside the first: a round, and the pairs
        try:
            value_at_end(self.problem)  # raises where the law cannot rest: no plan could be made
            self.estimator = simulator.row.estimator
            simulator.begin(least)
            self.keep_margin(simulator.row, simulator.episodes)
            self.say(f"{len(simulator.episodes)} episodes of the MPC, half with random inputs")
            trial = SimulatorTrial(simulator)
            if self.layer.network.is_zero():
                trial.extend(FIRST_LOOK)
                assert trial.played is not None
                simulator.learn(*trial.played)
            else:
                next(trial.stages(self.act(), [FIRST_LOOK]))
                before, _ = trial.check(0, RULE.significance, final=False)
                self.note(before, f"learnt before, {before.starts_in_words}", before.verdict)
            best = before.change if before is not None and before.accepted else 0.0
            model, note = self._rounds(simulator, trial, best)
            if not note:
                accepted = self._confirm(simulator, model, best)
        except OutOfStepsError:
            note = f"max_steps = {max_steps:,} are too few to go on, {simulator.steps:,} are taken"
            needed = {"at best": least, "for all rounds and tries": most_episodes(self.rounds)}
            steps = {words: simulator.needed(later) for words, later in needed.items()}
            more = [f"{words} {n:,}" for words, n in steps.items() if n > simulator.counted.most]
            endless = ": an episode takes more, or has no end: wrap the env in a TimeLimit"
            note += f"; {', '.join(more)} are needed" if more else endless
        finally:
            simulator.close()
        change = self.checks[-1].change if accepted else 0.0
        where = "the simulator", simulator.name, simulator.played, simulator.steps
        checks = tuple(self.checks)
        return Improvement(checks, change, accepted, before, *where, note=note)

    def _model(self, simulator: Simulator, number: int) -> LearntModel:
        """Return a model of all episodes so far.

        The first one says whether it is a family; then it is fitted to more episodes, from starts
        whose constants are others.
        """
        seed = self.seed + number

        def fitted() -> LearntModel:
            found = model_of(self.problem, simulator.episodes, simulator.row.estimator, seed)
            return found if number and not self.is_family else Family.of(found, seed)

        model = fitted()
        if number:
            return model
        self.is_family = isinstance(model, Family)
        more = min(2 * simulator.usual, (simulator.affordable() - most_episodes(self.rounds)) // 2)
        enough = more >= simulator.usual // 2 and not simulator.row.is_estimate
        if not (enough and self.is_family):
            return model
        self.say(f"a constant that no reading shows: {more} more episodes with random inputs")
        simulator.excite(more)
        return fitted()

    def _taught(
        self, simulator: Simulator, lost: list[Any], number: int
    ) -> tuple[LearntModel, Teacher]:
        """Return a model of all episodes so far, and plans in it: of what was lost first."""
        self.say(f"a model of {len(simulator.episodes)} episodes, and {self.n_starts} plans in it")
        model = self._model(simulator, number)
        self.confine_to(model)
        order = self.rng.permutation(len(simulator.episodes))
        # Twice each: as it began, and elsewhere with the same references.
        chosen = [each for one in lost[: self.n_starts // 4] for each in (one, one)]
        chosen = [*chosen, *(simulator.episodes[i] for i in order)][: self.n_starts]
        # Beside each scenario that is planned nine show what a policy has not learnt.
        drawn = self.rng.integers(len(order), size=9 * self.n_starts)
        others = [simulator.episodes[i] for i in drawn]
        midway = len(others) // 2
        scenarios = Scenarios.like(model, chosen + others, self.rng, midway)
        # After each refusal on new starts, lost ones count eight times as much as before.
        caution = 8.0 ** max(0, number + 1 - self.rounds)
        sizes = len(chosen), len(scenarios) - midway
        teacher = Teacher(scenarios, self.seed + number, *sizes, caution)
        teacher.show(self.act() if number else None)
        return model, teacher

    def _rounds(
        self, simulator: Simulator, trial: SimulatorTrial, best: float
    ) -> tuple[LearntModel, str]:
        """Fit, plan and imitate until the simulator shows what plans gain, or nothing more."""
        lost: list[Any] = []
        weights = copy.deepcopy(self.layer.state_dict())
        least = best
        note = ""
        self.say.end_of_round()
        for number in range(self.rounds):
            model, teacher = self._taught(simulator, lost, number)
            promised = imitate(self.layer, teacher, self.updates, partial(self.say, detail=True))
            if max(promised, teacher.gain) < RULE.least_gain:
                note = f"plans {change_in_percent(-teacher.gain)}, too little to teach"
                break
            next(trial.stages(self.act(), [len(trial.starts.seeds)]))
            found, _ = trial.check(number + 1, RULE.significance, final=False)
            self.say.end_of_round()
            changes = found.logged, -promised, -teacher.gain
            own, modelled, planned = map(change_in_percent, changes)
            how = f"round {number + 1} of at most {self.rounds}, {found.starts_in_words}"
            verdict = f"a start's own change {own} on average; from other starts in the model "
            verdict += f"{modelled}, plans {planned}"
            self.note(found, how, verdict)
            lost = trial.lost
            useful = found.safe and found.change < least
            # Another round must raise the gain by 2 %.
            stalls = least < best and found.change > 1.02 * least
            # Ten starts may hold none that gains: the confirmation has others.
            hopes = least == best and found.safe and found.change - promised < 2 * best
            if useful or hopes:
                weights = copy.deepcopy(self.layer.state_dict())
                note = ""
            elif least == best:
                note = found.reason or "no gain in the simulator"
            least = found.change if useful else least
            played = [each for each in trial.episodes if each is not None]
            asks = useful and found.accepted
            ends = number > 0 and stalls
            if number + 1 == self.rounds or not (played and (asks or ends)):
                continue
            same = Teacher(Scenarios.like(model, played), self.seed)
            if asks:
                same.show(self.act())  # plans may begin with what the policy does
                if -found.logged >= PROMISED * same.gain:
                    break
            # Where the simulator shows less than the model says, there is more to learn.
            if ends and -found.logged >= PROMISED * same.saved(same.play(self.layer).costs):
                break
        self.layer.load_state_dict(weights)
        return model, note if least == best else ""

    def _confirm(self, simulator: Simulator, model: LearntModel, best: float) -> bool:
        """Let the simulator decide; teach what is lost, at most three times, then retreat."""
        for attempt in range(TRIES + 1):
            self.say.rounds = max(TRIES - 1 - attempt, 0)
            self.say.confirmations = TRIES + 1 - attempt
            if attempt == TRIES:
                self.scale(RETREATS[0], self.layer.state_dict())
            share = RULE.significance / (TRIES + 1)  # all tries together err with no more
            found, trial = confirm(self.act(), simulator, len(self.checks) + 1, self.say, share)
            if found.accepted and not found.change < best:
                found = replace(found, accepted=False, reason="the model's own policy is as good")
            self.note(found, f"confirmation, {found.starts_in_words}", found.verdict)
            if found.accepted:
                self.accept(model)
                return True
            if TOO_LITTLE in found.reason:  # nothing was lost that could be taught
                break
            if attempt < TRIES - 1:
                model, teacher = self._taught(simulator, trial.lost, self.rounds + attempt)
                imitate(self.layer, teacher, self.updates, partial(self.say, detail=True))
                self.say.end_of_round()
        return False
