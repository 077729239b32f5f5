"""A learnt policy put to work on a plant, batch by batch; only accepted policies act."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._archive import digest_of
from sb3_yann._progress import bar, say, shown
from sb3_yann._validation import Array, Feedback, check_bool, check_int, check_range, check_type
from sb3_yann.audit.meaning import explained
from sb3_yann.commissioning.journal import (
    ACCEPTED_MPC,
    Accepted,
    Batch,
    CommissioningState,
    Journal,
    Record,
    Verdict,
    uninterrupted,
)
from sb3_yann.commissioning.plant import Plant, PlantEpisode
from sb3_yann.commissioning.watchdog import Watchdog
from sb3_yann.compare import RULE, Difference, allowed_excess, level_of_look
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import BoundExcess, BoundNames, costs_of, excess_of_episodes
from sb3_yann.env_pool import Source, observer_of, one_env
from sb3_yann.evaluation import paired_rows, summary_lines
from sb3_yann.improvement import improve
from sb3_yann.improvement.imitation import controller_of
from sb3_yann.improvement.simulator import Scenarios
from sb3_yann.policy.checkpoint import ActorCheckpoint, fingerprint, restore_whole, whole_policy
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.rollout import preserve_rng
from sb3_yann.twin.plant_twin import PlantTwin

Whole = tuple[dict[str, Any], list[Any]]  # weights and optimizers: see `whole_policy`


@dataclass(frozen=True)
class Commissioned:
    """What a commissioning has left in a model; it travels in its zip, in ``model.commissioned``.

    ``kept`` is the policy that the plant has confirmed, as in `Commissioning`, ``report`` the text
    of then, and ``policy`` the fingerprint of the actor.
    """

    kept: str
    report: str
    policy: str

    @property
    def accepted(self) -> bool:
        """Whether the plant has confirmed a policy that is not the MPC."""
        return self.kept != "MPC"


class Commissioning:
    """Puts a better policy to work on a plant as plants are commissioned: in growing batches.

    The first batch is the MPC's. After each one the twin is fitted to all that the plant has shown,
    and a policy is improved in it (:func:`improve`). One that was accepted there takes turns with
    the MPC, and only these pairs decide: it is kept where it surely costs less, with an error of
    5 % over all looks, and taken back where it surely costs more, shows no gain, violates or
    alarms. It acts at first within a small ``max_correction``, which doubles with each one that is
    kept. Nothing else ever acts; ``docs/improve.md`` has the rules.

    What counts is the stage cost, or the plant's own reward where that is another one. At an alarm
    of the watchdog the MPC has the plant within the same sample, until it has played a quiet
    episode. Two in a row with an alarm of how it moves are taken for a changed plant: the log
    begins anew.

    Each episode and each decision is on the disk before the next begins: after a kill the same
    script repeats nothing but the episode that was cut off. When :meth:`run` returns, the model
    holds the policy that the plant has confirmed last, or the MPC.

    Parameters
    ----------
    model : DDPG or TD3
        With a :class:`YannPolicy`. A policy that it has learnt before is tried as any other.
    plant_env : gymnasium.Env, str or callable
        The plant. It is reset with a seed, which a real one ignores. The twins have the observer
        among the wrappers of the model's env, or of this one.
    batch : int, default 4
        Episodes in the first batch, at least 2; each one is twice as long as the one before.
    max_correction : float, default 0.1
        The first bound of what is added to the MPC's inputs, as a fraction of their range.
    log_path : path-like, optional
        The record: a file of one line of JSON for each event, or a folder for it. The accepted
        models lie beside it.
    excite : float, default 0
        How far inputs may be moved at random beside the MPC's, as a fraction of their range, in
        every other episode while no policy is on trial: so a log of the MPC alone shows their
        gains.
    shadow : bool, default False
        The MPC acts throughout; the record shows what the policy would have done.
    rounds, updates : int, default 4 and 4000
        As in :func:`improve`.
    seed : int, default 0
        Of the episodes, the twins and the improvements.
    verbose : int, default 0
        1 prints each batch.
    progress_bar : bool, default True
        Whether to show, on stderr, what takes more than three seconds and how long.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, or the record is another commissioning's.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import Commissioning
    >>> plant = gym.make("CSTR-v0", max_episode_steps=20)
    >>> model = DDPG("YannPolicy", plant, device="cpu")
    >>> first = Commissioning(model, plant, batch=2, rounds=1, updates=100).run(batches=1)[0]
    >>> first.acted, first.episodes
    ('MPC', 2)
    """

    def __init__(  # noqa: PLR0913 (each is a choice of whoever owns the plant)
        self,
        model: OffPolicyAlgorithm,
        plant_env: Source,
        *,
        batch: int = 4,
        max_correction: float = 0.1,
        log_path: str | PathLike[str] | None = None,
        excite: float = 0.0,
        shadow: bool = False,
        rounds: int = 4,
        updates: int = 4000,
        seed: int = 0,
        verbose: int = 0,
        progress_bar: bool = True,
    ) -> None:
        check_type("model", model, OffPolicyAlgorithm, "a DDPG or TD3 model")
        self.policy = require_yann_policy(model.policy, "Commissioning")
        wanted = "the id of an environment, a gymnasium.Env or a function that makes one"
        check_type("plant_env", plant_env, str | gym.Env | Callable, wanted)
        self.model = model
        self.plant_env = plant_env
        self.verbose = verbose
        self.batch = check_int("batch", batch, 2)
        self.smallest = check_range("max_correction", max_correction, 0, 1, "(]")
        self.excite = check_range("excite", excite, 0, 1, "[]")
        self.shadow = check_bool("shadow", shadow)
        self.rounds = check_int("rounds", rounds)
        self.updates = check_int("updates", updates)
        self.seed = check_int("seed", seed, 0)
        self.progress_bar = check_bool("progress_bar", progress_bar)
        self.twin: PlantTwin | None = None
        self.watchdog: Watchdog | None = None
        self.observer = observer_of(model.get_env()) or observer_of(plant_env)
        # What the model has learnt before is nobody's yet: it waits to be tried.
        has_learnt = not self.policy.actor.mu.network.is_zero()
        self.candidate: Whole | None = whole_policy(self.policy) if has_learnt else None
        with preserve_rng():  # building an actor draws weights
            ActorCheckpoint.of_mpc(self.policy).restore(self.policy)
        self._mpc = whole_policy(self.policy)
        self._acting: Whole = self._mpc
        self._kept: Whole = self._mpc
        record = Record(None if log_path is None else Path(log_path))
        bound = 1.0 if self.policy.max_correction is None else self.policy.max_correction
        # A model that was saved meanwhile has the bound of then.
        self.largest: float = record.events[0].get("largest", bound) if record.events else bound
        self._first_bound = min(self.smallest, self.largest)
        problem = self.policy.problem
        own = problem.deviations
        parts = [*problem.prediction, problem.stage_matrix, own.theta_min, own.theta_max]
        parts += [problem.theta_ss, problem.model.u_ss, own.terminal.cost]
        parts += [problem.price.x, problem.price.u, *own.terminal.set]
        for kind, (value, softness, _) in own.bounded.items():
            parts += [value, softness, *own.limit_rows(kind)]
        parts.append(np.array([own.horizon, own.gamma, own.soft.penalty or 0.0]))
        numbers = {"options": np.array([str(own.control_horizon), own.infeasible])}
        for i, part in enumerate(parts):  # to digits that another processor has, too
            size = float(np.max(np.abs(part[np.isfinite(part)]), initial=0.0)) or 1.0
            numbers[f"{i} in {size:.6e}"] = np.round(part / size, 7) + 0.0
        names = "batch", "excite", "shadow", "rounds", "updates", "seed"
        begin = {name: getattr(self, name) for name in names}
        begin["max_correction"] = self.smallest
        begin["learner"] = f"{type(model).__name__} {self.policy.actor.net_arch}"
        begin["problem"] = digest_of(numbers)[:16]
        begin["largest"] = self.largest
        self.journal = Journal(record, begin, CommissioningState(self._first_bound))
        if self.journal.batches:
            state = self.journal.state
            self._kept, self._acting = (self._loaded(each) for each in (state.kept, state.acting))
            self.candidate = None if state.tried else self.candidate
            self._show()
            if state.twin is not None:
                with shown(self.progress_bar):
                    self.twin = self._fit(state.twin, state.twin_seed)
                self.watchdog = Watchdog.of(self.twin)

    @property
    def batches(self) -> list[Batch]:
        """All batches so far, those of a resumed record included."""
        return [*self.journal.batches]

    @property
    def kept(self) -> str:
        """The policy that the plant has confirmed: "MPC", or the batch after which it came."""
        return self.journal.state.kept.policy

    @property
    def episodes(self) -> list[PlantEpisode]:
        """All episodes so far."""
        return [*self.journal.episodes]

    def run(self, batches: int) -> list[Batch]:
        """Play until there are so many batches in all, those of a resumed record too; return them.

        Raises
        ------
        ValueError
            If the first reading of an episode is not finite. It does not count: run again.
        RuntimeError
            If an episode does not end in a million steps, or another run has the record.
        """
        check_int("batches", batches)
        if len(self.batches) >= batches:
            return self.batches
        locked = self.journal.record.locked()
        with locked, shown(self.progress_bar), one_env(self.plant_env) as env:
            plant = Plant(env, self.model)
            try:
                while len(self.batches) < batches:
                    size = self._size_of_batch()
                    played = bar(f"batch {len(self.batches) + 1}: episodes", total=size)
                    played.update(len(self.journal.batch))
                    while len(self.journal.batch) < size and not self._changed:
                        self._play(plant)
                        played.update()
                    played.close()
                    self._decide(plant)
            finally:
                with uninterrupted():
                    self._show()
        return self.batches

    def report(self) -> str:
        """Return the batches as a table, and what the pairs of the policy on trial show."""
        journal = self.journal
        state = journal.state
        verdict = "The MPC acts."
        rows = {}
        if journal.accepted:
            verdict = f"The policy of {state.policy} is on trial."
            if state.is_kept:
                verdict = f"The policy of {state.policy} surely costs less than the MPC, and acts."
            elif self.kept != "MPC":
                verdict += f" That of {self.kept} surely costs less than the MPC, and is kept."
            rows = {"change": "no pair of the policy on trial has been played yet"}
            if journal.pairs:
                problem = self.policy.problem
                pays_own = pays_its_own(problem, journal.episodes)
                both = (_costs(problem, e, pays_own) for e in zip(*journal.pairs, strict=True))
                level = level_of_look(RULE.significance, len(journal.trial))  # over all looks
                rows = paired_rows(*both, level=level, in_turns=True)
            verdict += " Costs above are means of each one's own episodes; only pairs compare them."
        played = journal.episodes
        ours = [each for each, by in zip(played, journal.by_policy, strict=True) if by]
        of_policies = sum(each.violations for each in ours)
        of_mpc = sum(each.violations for each in played) - of_policies
        moved = sum(each.excited for each in played)
        aside = f"; {moved} moved at random do not count in costs" if moved else ""
        aside += f"; {journal.unended} that never ended are left out" if journal.unended else ""
        return summary_lines(
            f"{journal.report()}\n{verdict}",
            **rows,
            violations=f"{of_policies} steps of policies, {of_mpc} of the MPC",
            steps=f"{sum(len(each.actions) for each in played):,} of the plant in {len(played)} "
            f"episodes, {len(ours)} begun by policies{aside}",
            next=f"run(batches={len(self.batches) + 1}) plays "
            f"{self._size_of_batch() - len(journal.batch)} episodes more",
        )

    def _play(self, plant: Plant) -> None:
        journal = self.journal
        unsafe = any(each.unsafe for each, by_policy in journal.batch if by_policy)
        doubted = unsafe or journal.doubted or journal.cut_off >= 2
        trial = journal.accepted and not self.shadow
        number = len(journal.batch)
        turn = np.random.default_rng([self.seed, len(journal.batches), number // 2]).integers(2)
        acts = trial and not doubted and turn == number % 2
        excites = self.excite > 0 and not trial and not journal.doubted and number % 2
        self._become(self._acting, journal.state.max_correction)
        # A simulator gives both of a pair the same start, but not after an alarm: an odd start
        # would look like a changed plant.
        again = number % 2 if trial and not journal.doubted else 0
        first = plant.begin(self.seed + len(journal.episodes) - again)
        try:
            journal.begin(acts)
            act: Feedback = plant.policy if acts else plant.mpc
            if excites:
                act = plant.excited_mpc(self.seed + len(journal.episodes), self.excite)
            limit = float(allowed_excess(excess_of_mpc(journal, plant.problem).largest.max()))
            played = plant.play(first, act, self.watchdog, limit)
            journal.add(played, acts)
        except KeyboardInterrupt:
            journal.interrupt()
            raise

    def _size_of_batch(self) -> int:
        return int(self.batch * 2 ** (len(self.batches) - self.journal.state.anew))

    @property
    def _changed(self) -> bool:
        return self.watchdog is not None and self.journal.changed

    def _decide(self, plant: Plant) -> None:
        """Learn from the plant, compare it with what was predicted, and say who acts from here."""
        journal = self.journal
        number = len(self.batches) + 1
        before = journal.state
        by_policy = any(each for _, each in journal.batch)
        who, within = (before.policy, before.max_correction) if by_policy else ("MPC", 0.0)
        alarms = sum(each.alarm is not None for each, _ in journal.batch)
        self._become(self._acting, before.max_correction)
        twin = watchdog = None
        if self._changed:
            costs = compare(journal, plant, self.twin, None)
            state = CommissioningState(
                self._first_bound, first=len(journal.episodes), anew=number, tried=before.tried
            )
            verdict: Verdict = "begins anew"
            last = journal.episodes[-1].alarm
            reason = f"Two episodes in a row had an alarm. {last.message if last else ''}".rstrip()
        else:
            numbers = journal.log
            seed = self.seed + number
            fitted = self._fit(numbers, seed) if len(numbers) > 1 else None
            twin = fitted if fitted is not None and fitted.trusted else None
            costs = compare(journal, plant, self.twin, twin or self.twin)
            state = before if twin is None else replace(before, twin=numbers, twin_seed=seed)
            state, verdict, reason = self._judge(state, costs, fitted, number)
            watchdog = self.watchdog if twin is None else Watchdog.of(twin)
            twin = twin or self.twin
        if verdict == "accepted":
            saved = journal.record.save(self.model, number)
            acting = Accepted(f"batch {number}", saved, state.max_correction)
            state = replace(state, acting=acting, since=number)
        elif verdict != "stays":
            self._become(self._mpc, state.max_correction)
            state = replace(state, acting=ACCEPTED_MPC, kept=ACCEPTED_MPC, since=0)
        sizes = number, len(journal.batch), alarms
        acts = whole_policy(self.policy)
        shown = costs.actual, costs.predicted, costs.mpc
        pairs = costs.difference.pairs
        batch = Batch(*sizes, who, within, *shown, pairs, verdict, reason)
        with uninterrupted():  # an error or Ctrl-C before has changed nothing
            journal.close(batch, state)
            known = {before.kept: self._kept, before.acting: self._acting}
            self._kept = known.get(state.kept, self._mpc)
            self._acting = acts
            self.candidate = None if state.tried else self.candidate
            self.twin = twin
            self.watchdog = watchdog
        if self.verbose:
            say(self.journal.report().splitlines()[-1])

    def _judge(
        self, state: CommissioningState, costs: Costs, twin: PlantTwin | None, number: int
    ) -> tuple[CommissioningState, Verdict, str]:
        """Decide by the pairs, and improve where no policy is on trial."""
        if why := why_taken_back(self.journal, costs):
            text = f"The policy was taken back: {why}."
            kept = state.kept
            if kept.policy in ("MPC", state.policy):
                return replace(state, max_correction=self._first_bound), "the MPC acts", text
            self._become(self._kept, kept.bound)
            state = replace(state, acting=kept, max_correction=kept.bound, since=number)
            return state, "stays", text
        text = ""
        if self.journal.accepted and not state.is_kept:
            if not is_kept(costs):
                return state, "stays", f"{costs.difference.pairs} pairs are not enough."
            state = replace(state, kept=state.acting)
            text = f"{costs.difference.pairs} pairs show that it costs less. "
        verdict: Verdict = "stays" if state.is_kept else "the MPC acts"
        if twin is None:
            text += f"There are {len(self.journal.log)} episodes to learn from."
            return state, verdict, text
        if not twin.trusted:
            why = " ".join(["The twin is not trusted.", *twin.trust.problems])
            return state, verdict, f"{text}{why}"
        state = replace(state, tried=True)
        wider = state
        if state.is_kept:  # the plant has confirmed it: the next one may leave the MPC farther
            wider = replace(state, max_correction=min(2 * state.max_correction, self.largest))
        self._become(self.candidate or self._acting, wider.max_correction)
        seed = self.seed + number
        found = improve(self.model, twin, rounds=self.rounds, updates=self.updates, seed=seed)
        before = found.before
        if found.accepted or (before is not None and before.accepted and not state.is_kept):
            return wider, "accepted", f"{text}{found.change_in_words}."
        self._become(self._acting, state.max_correction)
        return state, verdict, f"{text}{found.reason}"

    def _become(self, whole: Whole, bound: float) -> None:
        """Give the model a policy, and bound it for good: a model that is saved keeps it."""
        restore_whole(self.policy, whole)
        self.policy.limit_correction(bound)

    def _show(self) -> None:
        """Give the model what the plant has confirmed, else the MPC, while nothing is played."""
        state = self.journal.state
        self._become(self._kept, state.max_correction if self.kept == "MPC" else state.kept.bound)
        record: Any = self.model
        record.commissioned = Commissioned(self.kept, self.report(), fingerprint(self.policy.actor))

    def _fit(self, numbers: list[int], seed: int) -> PlantTwin:
        episodes = [self.journal.episodes[i] for i in numbers]
        units = self.policy.problem.units
        log = [(units.to_plant(e.thetas), units.input_to_plant(e.actions)) for e in episodes]
        return PlantTwin.fit(self.policy.problem, log, observer=self.observer, seed=seed)

    def _loaded(self, accepted: Accepted) -> Whole:
        if accepted.model is None:
            return self._mpc
        self.journal.record.load(accepted.model, self.model)
        return whole_policy(self.policy)


class Costs(NamedTuple):
    """What the plant has shown; NaN where nothing is known.

    ``actual`` is the mean cost of the episodes of the one that acted in the batch, those with an
    alarm included, ``predicted`` what the twin had predicted of them, ``mpc`` what the MPC cost in
    turns with the policy. ``difference`` is of all pairs of the trial, ``look`` counts the looks at
    it. With ``own_reward`` costs are minus the rewards, which no twin knows. ``longer`` says by how
    much more than the MPC the policy exceeds hard bounds, summed over an episode.
    """

    actual: float = np.nan
    predicted: float = np.nan
    mpc: float = np.nan
    difference: Difference = Difference(np.nan, np.inf, 0)
    look: int = 1
    own_reward: bool = False
    longer: str = ""


def compare(
    journal: Journal, plant: Plant, before: PlantTwin | None, now: PlantTwin | None
) -> Costs:
    """Return what the present batch cost, and all pairs of the policy that is on trial.

    A plant does not repeat a start. Which of a pair plays first is drawn, so their starts differ by
    nothing on average, and so does what a twin says that the MPC costs from them: it is a control
    variate, taken where the differences vary less with it. It biases nothing, however wrong. The
    twin ``before`` was in force, ``now`` is the one that has learnt from the batch.
    """
    problem = plant.problem
    ours = [each for each, own in journal.batch if own]
    quiet = [each for each, own in journal.batch if not own and not each.alarm and not each.excited]
    acted = ours or quiet
    if not acted:
        return Costs()
    pays_own = pays_its_own(problem, journal.episodes)
    predicted = np.nan
    actual = float(_costs(problem, acted, pays_own).mean())
    if before is not None and not pays_own:
        act = plant.policy if ours else plant.mpc
        predicted = float(predicted_costs(before, acted, act).mean())
    mpc = float(_costs(problem, quiet, pays_own).mean()) if quiet else np.nan
    found = Costs(actual, predicted, mpc, own_reward=pays_own)
    if not ours:
        return found
    found = found._replace(look=len(journal.trial), longer=_longer(journal, problem, ours))
    if not journal.pairs:
        return found
    both = [*zip(*journal.pairs, strict=True)]
    more = np.subtract(*(_costs(problem, each, pays_own) for each in both))
    if now is not None and not pays_own:
        varied = more - np.subtract(*(predicted_costs(now, each, plant.mpc) for each in both))
        more = varied if np.isfinite(varied).all() and varied.std() < more.std() else more
    return found._replace(difference=Difference.of(more, in_turns=True))


def pays_its_own(problem: LinearMPC, episodes: Sequence[PlantEpisode]) -> bool:
    """Return whether the episodes' rewards are something else than minus their stage costs.

    They may differ by a constant and a factor. Rewards that are all the same are none.
    """
    rewards = np.array([[each.reward] for each in episodes])
    if not np.ptp(rewards) > 1e-9 * np.abs(rewards).max():  # nor does NaN
        return False
    costs = _costs(problem, episodes, False)[:, None]
    # 0.95: share of the episodes' rewards that the same stage cost explains
    return explained(-costs, rewards, np.isfinite(costs)) < 0.95


def why_taken_back(journal: Journal, costs: Costs) -> str:
    """Return what the plant says against the policy of the present batch; empty if nothing."""
    played = [each for each, by_policy in journal.batch if by_policy]
    if journal.cut_off >= 2:
        return f"{journal.cut_off} episodes that it began never ended"
    if not played:
        return ""
    if unsafe := sum(each.unsafe for each in played):
        return f"it violated a limit in {unsafe} steps"
    if costs.longer:
        return costs.longer
    alarms = sum(each.alarm is not None for each in played)
    # After an alarm in a quarter of its episodes, two at least, a policy is taken back.
    if alarms >= max(2.0, 0.25 * len(played)):
        return f"{alarms} of its {len(played)} episodes had an alarm"
    if not costs.difference.pairs:
        return "no pair of episodes shows what it costs"
    more = costs.difference.mean
    room = costs.difference.room(RULE.significance)
    # A policy may cost 5 % more than the MPC in any case.
    if not more <= min(room, 0.05 * abs(costs.mpc)):  # nor does NaN pass
        by = "by the plant's reward, " if costs.own_reward else ""
        return f"{by}it cost {costs.actual:.5g}, the MPC in turns with it {costs.mpc:.5g}"
    hopeless = costs.difference.is_hopeless(RULE.least_gain * abs(costs.mpc))
    enough = costs.difference.pairs >= 10  # so many that show no gain end a trial
    return f"{costs.difference.pairs} pairs show no gain" if enough and hopeless else ""


def is_kept(costs: Costs) -> bool:
    """Return whether the plant has shown that the policy surely costs less than the MPC.

    All looks at a policy together err with a probability of 5 % at most.
    """
    return costs.difference.is_below_zero(level_of_look(RULE.significance, costs.look))


def excess_of_mpc(journal: Journal, problem: LinearMPC) -> BoundExcess:
    """Return the excess over the bounds of the MPC's own episodes in the log, one 0 without any."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    pairs = [(each.thetas, each.actions) for each in own if not each.excited]
    return excess_of_episodes(problem, pairs) if pairs else BoundExcess(*np.zeros((5, 1)))


def _longer(journal: Journal, problem: LinearMPC, played: Sequence[PlantEpisode]) -> str:
    mpc = excess_of_mpc(journal, problem)
    ours = excess_of_episodes(problem, ((each.thetas, each.actions) for each in played))
    summed = float(ours.summed.mean())
    before = float(mpc.summed.mean())
    if summed <= allowed_excess(before) + mpc.largest.max():
        return ""
    most = int(np.argmax(ours.largest))
    words = BoundNames.of(problem).in_words(ours.worst[most], ours.largest[most])
    return (
        f"it exceeded hard bounds by {summed:.3g} half-widths, summed over an episode, the MPC by "
        f"{before:.3g}: {words}"
    )


def _costs(problem: LinearMPC, episodes: Sequence[PlantEpisode], own_reward: bool) -> Array:
    if own_reward:
        return np.array([-each.reward for each in episodes])
    return np.array([costs_of(problem, each.thetas, each.actions)[0] for each in episodes])


def predicted_costs(twin: PlantTwin, episodes: Sequence[PlantEpisode], act: Feedback) -> Array:
    """Return what a policy would have cost from each episode's start, by the members' mean.

    References and measured disturbances are those of the episodes.
    """
    row = twin.dynamics.row
    count = len(twin.dynamics.members)
    found = []
    for each in episodes:
        starts = row.begin(np.tile(each.thetas[0], (count, 1)))
        given = np.repeat(each.thetas[:-1, None, row.given], count, axis=1)
        played = Scenarios(twin, np.arange(count), starts, given).play(controller_of(act))
        found.append(played.costs.mean())
    return np.array(found)
