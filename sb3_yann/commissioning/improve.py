"""A better policy from a twin or a simulator: the gradient of the cost through it and the actor."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from rich.progress import track
from stable_baselines3 import DDPG
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import check_bool, check_int, check_range
from sb3_yann.commissioning.critic import refit_critic
from sb3_yann.commissioning.distillation import distill
from sb3_yann.commissioning.grounds import TwinGrounds
from sb3_yann.commissioning.imitation import ROUNDS, imitate
from sb3_yann.commissioning.incumbent import all_or_nothing
from sb3_yann.commissioning.search import Pace, Search, decisive
from sb3_yann.commissioning.simulator_grounds import RULE, SimulatorGrounds
from sb3_yann.commissioning.simulator_twin import SimulatorTwin
from sb3_yann.commissioning.trial import Check
from sb3_yann.control import LinearMPC
from sb3_yann.deployment.exporting import Exported, export
from sb3_yann.networks.yann import LawLayer
from sb3_yann.policy.policies import YannPolicy, require_problem_of_twin, require_yann_policy
from sb3_yann.rollout import Source, maker, name_of
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.trust import Trust

EXACT = 0.5
"""Errors of the twin relative to the given model's below which it is an exact one."""
LEAST, LEAST_OF_EXACT, OF_COST_ERROR = 2e-3, 2e-4, 0.1
"""What a policy must gain in a twin, and in an exact one, relative to the MPC's mean cost; and
relative to the error of the twin's costs."""

RACE = 3
"""Of two searches the better one goes on after such a part of the iterations."""

SETTINGS = (
    "iterations", "batch", "learning_rate", "reidentify", "confine", "n_starts", "check_every",
    "patience", "seed",
)  # fmt: skip
"""Arguments of `improve` that its record names."""

REFINED = 0.2
"""Factor of the learning rate where the re-identified MPC, or what plans taught, is refined."""


@dataclass(frozen=True)
class Improvement:
    """What :func:`improve` did; it travels in the model's zip, in ``model.improvements``.

    Attributes
    ----------
    checks : tuple of Check
        The comparisons with the MPC in the twin, or in the simulator, of the better search.
    change : float
        The accepted policy's mean cost there against the MPC's: -0.02 is 2 % less.
    accepted : bool
        Whether a policy passed that gains at least 0.2 %, or 0.02 % where the twin errs less than
        half as much as the given model, a tenth of what the twin's costs err by, and two standard
        errors on episodes like the log's; in a simulator 0.1 %, and two standard errors of what an
        episode gains. If none did, the model is as it was.
    before : Check, optional
        Of what the model had learnt before, if it had.
    where : {"the twin", "the simulator"}
    source : str
        Which twin or simulator.
    episodes : int
        Of the log that the twin was fitted to, or played in the simulator to compare.
    settings : dict of str to number
        The arguments.
    policy : str
        Fingerprint of the policy's weights when it ended.
    model : DDPG or TD3, optional
        With the policy; not in the model's zip.

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
    settings: dict[str, float] = field(default_factory=dict)
    policy: str = ""
    model: Any = field(default=None, repr=False, compare=False)

    def export(self, path: str | PathLike[str], **options: Any) -> Exported:
        """Write the policy as a file or as code: :func:`sb3_yann.export` of the model."""
        return export(self.model, path, **options)

    @property
    def reason(self) -> str:
        """Why nothing was accepted; empty where something was."""
        if self.accepted:
            return ""
        found = decisive(self.checks)
        passed = (each for each in found if each.accepted and each is not self.before)
        best = min((each.change for each in passed), default=0.0)
        small = f"a gain of {-100 * best:.2g} % in {self.where} is too small, or not sure"
        last = small if best < 0 else self.checks[-1].reason or f"no gain in {self.where}"
        said = f"Nothing better was found: {last}."
        if self.where == "the twin":  # plans of a steep plant take minutes, and are the twin's own
            said += (
                " In a twin the search makes no plans: headroom(mpc, twin) tells what they would "
                "gain there, and improve(model, simulator) begins at them."
            )
        return said

    def report(self) -> str:
        """Return in words what was accepted, or why nothing was, and how many checks it took."""
        passed = sum(each.accepted for each in self.checks)
        taken = f"{passed} of {len(self.checks)} checks passed."
        if not self.accepted:
            return f"{self.reason} The model is as it was. {taken}"
        last = next((each for each in reversed(self.checks) if each.accepted), None)
        said = f"Accepted: {100 * self.change:+.2f} % of the MPC's stage cost in {self.where}"
        if last is not None:
            twin = self.where == "the twin"
            whose = "on episodes like the log's" if twin else "of an episode's own on average"
            said += f", {100 * last.logged:+.2f} % (± {100 * last.error:.2f}) {whose}"
            said += f", {100 * last.worst:+.2f} % from the worst start"
        return f"{said}. {taken}"

    __str__ = report


def improve(  # noqa: PLR0913 (settings of a user, each by its name)
    model: OffPolicyAlgorithm | LinearMPC,
    twin: PlantTwin | Source,
    iterations: int = 120,
    *,
    batch: int = 50,
    learning_rate: float = 5e-3,
    reidentify: bool = True,
    confine: bool = True,
    n_starts: int = 40,
    check_every: int = 20,
    patience: int = 5,
    seed: int = 0,
    progress_bar: bool = False,
) -> Improvement:
    """Improve a model's policy in a twin of its plant, or in a simulator; the plant sees nothing.

    The actor's parameters follow the gradient of the summed stage cost through unrolled runs of
    twin and actor, with the linear-quadratic value at the end. Every so many steps the policy is
    checked against the MPC, from seeded starts on every member of the twin. It is accepted if no
    start costs more than with the MPC by 0.05 % of the mean, none violates more, and the mean is
    not above that of the accepted policy. A start outside the log may cost 0.5 % of its own more,
    and up to ten times as much the rarer it is. Of what is refused, a half and a quarter are tried.
    What passes is confirmed on new starts, where the twin's second opinion, a model without a form,
    must see a gain as well and no start dearer by 1 %. In the end it must gain 0.2 %, or 0.02 %
    where the twin errs less than half as much as the given model. On episodes that go on as those
    of the log it must gain twice the standard error, over episodes and members. Starts that it
    loses, or nearly, are played in the gradients to come. What the model has learnt before is
    checked first. Beyond what the log shows the MPC acts alone: no member of the twin knows the
    plant there.

    Two searches run, one from the present policy and one from the re-identified MPC. After a third
    of the iterations the better one goes on.

    In a *simulator* the first search begins at nearly optimal plans, those of :func:`headroom`,
    which the actor imitates; what it then loses is planned anew, and learnt, until new episodes
    show no loss or it becomes no less. The gradient goes
    through the simulator's own steps where it can be put into a state and repeats them, else
    through a twin of its episodes. Checks are its own episodes, by the rule that an
    :class:`ImprovementGuard` has by default. In the end many new ones decide, of which none has
    been played before; of what they refuse, the policy that was accepted first is tried, then half
    and a quarter of the correction. Where this search finds nothing, one from the present policy
    follows.

    The model ends with the policy accepted last and a critic that is refitted to it, else as it
    was. It saves and goes on learning as any other.

    Parameters
    ----------
    model : DDPG, TD3 or LinearMPC
        With a :class:`YannPolicy` of the twin's problem. An MPC gets a DDPG model of its own, which
        the result holds: ``result.model``, ``result.export("controller.c")``.
    twin : PlantTwin, gymnasium.Env, str or callable
        A twin, which must be trusted; or a simulator, which shows theta of the model's problem, in
        plant units where that is. The problem's stage cost counts, and no reward: a
        :class:`CostMismatchWarning` says where that is another one. A function or an id makes as
        many as are played side by side, a given env is copied.
    iterations : int, default 120
        Gradient steps, at most.
    batch : int, default 50
        Runs in each.
    learning_rate : float, default 5e-3
        Of Adam at first; it falls to zero. A search from plans or from the re-identified MPC has a
        fifth of it.
    reidentify : bool, default True
        Whether a search begins at the re-identified MPC (:meth:`PlantTwin.reidentified`), if its
        law has at most ten times as many regions. Not in a simulator, where one begins at plans.
    confine : bool, default True
        Whether the MPC acts alone beyond what the log shows: see
        :meth:`YannPolicy.confine_correction`. A simulator knows the plant there too.
    n_starts : int, default 40
        Starts of a check, for each member: so many as the log begins, and as many around. In a
        simulator so many episodes are planned; a check has twice as many, six times as many new
        ones confirm it, and 72 times as many decide in the end.
    check_every : int, default 20
        Steps from one check to the next.
    patience : int, default 5
        Checks without an acceptance after which to stop.
    seed : int, default 0
        Of the starts. No other random numbers are drawn.
    progress_bar : bool, default False
        Whether to show one.

    Raises
    ------
    UntrustedTwinError
        If the twin is not to be trusted: the model stays as it is.
    TypeError, ValueError
        If the model has no YannPolicy, or another problem than the twin or the simulator.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import PlantTwin
    >>> from sb3_yann.evaluation import evaluate
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> log = evaluate(model, "CSTR-v0", seeds=range(5))  # a plant's own episodes
    >>> twin = PlantTwin.fit(model.policy.problem, [*zip(log.observations, log.actions)])
    >>> improve(model, twin, iterations=40).change < -0.005
    True

    ``improve(model, "CSTR-v0")`` does it in the simulator.
    """
    given = dict(locals())
    if not isinstance(model, OffPolicyAlgorithm | LinearMPC):
        raise TypeError(f"model = {model!r} must be a DDPG or TD3 model, or a LinearMPC.")
    if not (isinstance(twin, PlantTwin | str | gym.Env) or callable(twin)):
        raise TypeError(
            f"twin = {twin!r} must be a PlantTwin; or a simulator: a single gymnasium.Env, its id, "
            "or a function that makes one."
        )
    if isinstance(model, LinearMPC):
        model = DDPG(
            YannPolicy,
            twin.env() if isinstance(twin, PlantTwin) else maker(twin)(),
            gamma=min(model.gamma, 0.99),
            seed=check_int("seed", seed, 0),
            device="cpu",
            policy_kwargs={"problem": model},
        )
    policy = require_yann_policy(model.policy, "improve")
    if isinstance(twin, PlantTwin):
        require_problem_of_twin(policy, twin.problem)
    counts = {"iterations": iterations, "batch": batch, "n_starts": n_starts}
    for name, value in (counts | {"check_every": check_every, "patience": patience}).items():
        check_int(name, value)
    check_range("learning_rate", learning_rate, 0, np.inf, "()")
    check_int("seed", seed, 0)
    for name, flag in {"reidentify": reidentify, "confine": confine}.items():
        check_bool(name, flag)
    check_bool("progress_bar", progress_bar)
    layer = copy.deepcopy(policy.actor.mu).cpu()
    pace = Pace(iterations, learning_rate, check_every, patience)
    if isinstance(twin, PlantTwin):
        twin.require_trust()
        layer.confine(*twin.starts.shown) if confine else layer.confine(None, None)
        searches = _in_twin(layer, TwinGrounds(twin, batch, n_starts, seed), pace, reidentify)
        leg, least, where = -(-iterations // RACE), least_gain(twin.trust), "the twin"
        found = _improved(policy, searches, max(check_every, leg), least, where, progress_bar)
        source, episodes = repr(twin), len(twin.episodes)
    else:
        simulator = SimulatorTwin.of(policy.problem, twin, seed)
        try:
            grounds = SimulatorGrounds(simulator, batch, n_starts, seed)
            searches = _in_simulator(layer, grounds, pace, progress_bar)
            least = RULE.least_gain
            found = _improved(policy, searches, 0, least, "the simulator", progress_bar)
        finally:
            simulator.close()
        source, episodes = name_of(twin), len(simulator.seeds) + sum(simulator.played)
    settings = {name: given[name] for name in SETTINGS}
    prints = fingerprint(policy.actor.state_dict())
    found = replace(found, source=source, episodes=episodes, settings=settings, policy=prints)
    record: Any = model
    record.improvements = (*getattr(model, "improvements", ()), found)
    return replace(found, model=model)


def fingerprint(state: dict[str, th.Tensor]) -> str:
    """Return the SHA-256 of tensors, whatever their order and device."""
    found = hashlib.sha256()
    for name in sorted(state):
        found.update(name.encode())
        found.update(np.ascontiguousarray(state[name].cpu().numpy()).tobytes())
    return found.hexdigest()


def _in_twin(layer: LawLayer, grounds: TwinGrounds, pace: Pace, reidentify: bool) -> list[Search]:
    """Return a search from a layer as it is, and one from the re-identified MPC."""
    searches, today = [Search(layer, grounds, pace)], copy.deepcopy(layer)
    if reidentify and distill(today, grounds.twin, grounds.seed):
        slower = replace(pace, learning_rate=REFINED * pace.learning_rate)
        searches.append(Search(today, grounds, slower))
    return searches


def _in_simulator(
    layer: LawLayer, grounds: SimulatorGrounds, pace: Pace, progress_bar: bool
) -> list[Search]:
    """Return a search from a layer as it is, and one from plans that it imitated, if worth it."""
    taught = copy.deepcopy(layer)
    fits = imitate(taught, grounds, grounds.seed)
    if not [*track(fits, "imitating plans", ROUNDS, disable=not progress_bar)]:
        return [Search(layer, grounds, pace)]
    slower = replace(pace, learning_rate=REFINED * pace.learning_rate)
    return [Search(layer, grounds, pace), Search(taught, grounds, slower)]


def _improved(
    policy: YannPolicy,
    searches: list[Search],
    leg: int,
    least: float,
    where: str,
    progress_bar: bool,
) -> Improvement:
    """Search, and give the policy what was accepted.

    Parameters
    ----------
    policy : YannPolicy
        Whose actor and critic are changed, or not.
    searches : list of Search
        The first one begins at the policy.
    leg : int
        Iterations that all of them run before the better one goes on.
    least : float
        What must be gained, as a fraction of the MPC's mean cost.
    where : {"the twin", "the simulator"}
        For the report.
    progress_bar : bool
        Whether to show one.
    """
    own = policy.actor.mu.state_dict()
    grounds, pace = searches[0].grounds, searches[0].pace
    before = None if policy.actor.mu.network.is_zero() else searches[0].checks[0]
    leg = min(pace.iterations, leg)
    total = pace.iterations + (len(searches) - 1) * leg
    for _ in track(_race(searches, leg, least), "improving", total, disable=not progress_bar):
        pass
    # Where none gains, the one that came to the final trial tells most.
    search = min(searches, key=lambda each: (each.change, not any(c.final for c in each.checks)))
    change = search.change
    moved = any(not th.equal(own[key].cpu(), each) for key, each in search.accepted.items())
    if not moved or not search.gains(least):
        return Improvement(tuple(search.checks), 0.0 if moved else change, False, before, where)
    with all_or_nothing(policy):
        policy.actor.mu.load_state_dict(search.accepted)
        policy.actor_target.load_state_dict(policy.actor.state_dict())
        for network in (policy.actor, policy.critic):
            network.optimizer.state.clear()  # what other weights were moved by
        refit_critic(policy, grounds.twin, grounds.seed)
    return Improvement(tuple(search.checks), change, True, before, where)


def least_gain(trust: Trust) -> float:
    """Return what a policy must gain in a twin, as a fraction of the MPC's mean cost.

    What is promised is a difference of two predicted costs, which errs less than each of them, but
    not without end: an evaporator's twin that was off by a fifth promised 1 %, and cost 0.3 % more.
    """
    least = LEAST_OF_EXACT if trust.error_ratio < EXACT else LEAST
    return max(least, OF_COST_ERROR * trust.cost_error)


def _race(searches: list[Search], leg: int, least: float) -> Iterator[int]:
    """Yield after each gradient step: of all searches in the first leg, then of the best one.

    The others follow where that finds nothing worth a change, or loses the final trial. Of two that
    are as good, the one that begins elsewhere goes first, where there is no leg.
    """
    if len(searches) > 1:
        for each in searches:
            yield from each.steps(leg)
    order = searches if leg else [*reversed(searches)]
    for each in sorted(order, key=lambda each: each.change):
        yield from each.steps(each.pace.iterations)
        if each.confirm(least):
            break
