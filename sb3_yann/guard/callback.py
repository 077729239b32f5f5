"""The callback, and the part of it that both ways to decide share."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.interrupt import Handler, install
from sb3_yann.guard.plant_acceptance import PlantAcceptance
from sb3_yann.guard.preconditions import check_between, check_not_nested, check_whole
from sb3_yann.guard.restoring import restore_accepted
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.simulator_acceptance import SimulatorAcceptance
from sb3_yann.guard.state import Decision, GuardState, append_csv, write_csv
from sb3_yann.policy._finite import watch_buffer
from sb3_yann.policy.policies import YannPolicy


class ImprovementGuard(BaseCallback):
    """Takes back what does not improve on the MPC, start by start.

    Every few training episodes the present actor is a candidate. It is accepted where it is no
    worse than the last accepted one. Otherwise it is refused: at once, or when ``patience`` is
    over, actor, target actor and the actor's optimizer return to the accepted state, bit for bit,
    while the critic goes on learning. A return shrinks the actor's steps, an acceptance lets them
    grow again. When `learn` returns, or is ended by Ctrl-C, the model *is* the accepted policy.
    Until then, after another exception, and in the zips of a CheckpointCallback, it is a candidate:
    :func:`restore_accepted` puts the accepted policy in its place.

    **With a simulator** (``env`` given) the deterministic policy plays seeded episodes there,
    from the same starts as the accepted policy and the untouched MPC did. It is refused if its
    mean cost is above the accepted policy's, if one start costs more than with the MPC by more than
    the margin, or if an episode has more steps with ``info["violation"]`` than the accepted
    policy's, or is terminated by the env where the accepted policy's is not. Regions that no
    episode comes through stay as they were. Where the whole is refused, the networks of some
    regions may still be accepted, under the same conditions. A refused candidate that is better
    than the MPC on average gets ``patience``. An error of the simulator is a refusal where the MPC
    meets none from the same starts.

    **On a plant alone** (``env=None``) the training episodes decide. The actor learns for
    ``trial_episodes`` episodes, then rests for as many, of which all are played by one and the same
    policy. It is accepted if it costs less than the accepted policy did, by a one-sided test of
    size ``significance`` (:func:`sb3_yann.guard.statistics.probability_of_chance`: an analysis of
    covariance on the cost that the linear model predicts for each start), and if none of its
    episodes costs far more than these explain. A violation at any time, a parameter that is no
    finite number, or a change of the actor while it rests, brings the accepted policy back at once;
    after a violation the actor rests until that episode is over. The first policy that is accepted
    is the one that training starts with, and plays the first block: alone, without the noise and
    the random actions that NoActionNoise takes away. Each test errs with probability
    ``significance``, so a policy that is worse *can* pass: of ten candidates that are no different
    one or more does in a quarter of all cases. Nor does the test see what is rare, or what has
    changed meanwhile: a policy that loses one start in ten by 200, where an episode costs 60, and
    gains 12 on the others, passes in a third of the cases (it loses none in its block); and as
    the accepted block is not played again, a plant that has become 10 % cheaper in between lets an
    unchanged policy pass in two thirds. The simulator's paired episodes have no such chance, but
    hold for their starts only.

    The guard draws no random numbers and leaves the training env and the buffer alone. Its state
    is an attribute of the model, ``model.guard_state``, and is saved and loaded with it: another
    guard with the same settings goes on where the last one stopped, if a few episodes show that
    the simulator is still the same; with other settings what was accepted is tried anew. Scalars in
    tensorboard are ``guard/candidate_cost``, ``guard/accepted_cost``, ``guard/mpc_cost``,
    ``guard/worst_start``, ``guard/step``, ``guard/accepted`` and ``guard/rejected``.

    Parameters
    ----------
    env : str, gymnasium.Env, callable or None
        The simulator: an id, an env of its own (not the training env), or a function that makes
        one; the first and the last run all starts side by side. None decides from the training
        episodes.
    n_starts : int, default 100
        Number of seeded starts.
    fresh : int, default 50
        Number of new starts, others each time, on which a policy is tried once more before it is
        accepted. It loses by one start, as above, or by a mean cost above the MPC's. Then the ten
        hardest of these starts join the others for good, and the last policy accepted before that
        passes on all of them is put back, or the MPC. 0 is for none.
    final : int, optional
        Number of new starts on which what is accepted is tried in the same way when training ends.
        The default is ten times ``fresh``; 0 is for none. A policy that loses at least one start
        in n / 3 passes on n with a probability below 5 % (the rule of three), one of k that are
        tried in turn with at most k times that. Ten thousand take some seconds where the env is
        named and steps as arrays; a function that makes one is called for each start.
    seed : int, default 1_000_000
        The seed of the first start; the others follow.
    every : int, default 1
        Training episodes from one candidate to the next.
    margin : float, default 0.01
        What one start may cost more than with the MPC, as a fraction of the MPC's median cost.
    by_region : bool, default True
        Whether to try single regions where the whole is refused.
    patience : int, default 5
        Refusals in a row after which the actor returns. Until then it goes on from where it is, and
        plays: the critic learns from that. 1 returns after each one.
    wander : bool, default False
        Whether that holds for a candidate whose mean cost is above the MPC's as well. By default it
        returns at once; so it does after a violation, in any case. True where the way to a
        better policy leads through worse ones, and nothing is at stake but cost.
    shrink, grow, smallest_step : float, default 0.5, 1.5 and 0.1
        Factors of the step at a rejection and an acceptance (up to 1), and what it never falls
        below.
    trial_episodes : int, default 10
        Training episodes of a block, on a plant alone.
    significance : float, default 0.05
        Size of the test, on a plant alone.
    record : path-like, optional
        A CSV file of all decisions, up to date after each one (see :class:`Decision`);
        ``guard.decisions`` has them too. There are none before the critic's warm-up is over.
    verbose : int, default 0
        1 prints each decision.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range; when training starts, if the policy is no YannPolicy, the
        simulator is the training env or gives costs that are no numbers, the guard is within an
        EveryNTimesteps or the like, or, on a plant alone, if other actions than the policy's are
        to be played.
    """

    model: OffPolicyAlgorithm

    interrupted = False
    """Whether Ctrl-C has put the accepted policy back, so that nothing else may be."""
    before_trial: tuple[Any, Any, list[Any]] | None = None
    """What was accepted before the trial that is under way, with its evidence and ``passed``."""
    _handler: Handler | None = None

    def __init__(
        self,
        env: str | gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]] | None,
        *,
        n_starts: int = 100,
        fresh: int = 50,
        final: int | None = None,
        seed: int = 1_000_000,
        every: int = 1,
        margin: float = 0.01,
        by_region: bool = True,
        patience: int = 5,
        wander: bool = False,
        shrink: float = 0.5,
        grow: float = 1.5,
        smallest_step: float = 0.1,
        trial_episodes: int = 10,
        significance: float = 0.05,
        record: str | PathLike[str] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if not (env is None or isinstance(env, str | gym.Env) or callable(env)):
            raise TypeError(
                f"env = {env!r} must be the id of an environment, a gymnasium.Env, a function that "
                "makes one, or None to decide from the training episodes."
            )
        if record is not None and Path(record).is_dir():
            raise ValueError(f"record = {record!r} is a folder; name a file in it.")
        for name, value, least in (
            ("n_starts", n_starts, 1),
            ("fresh", fresh, 0),
            ("final", 0 if final is None else final, 0),
            ("seed", seed, 0),
            ("every", every, 1),
            ("patience", patience, 1),
            ("trial_episodes", trial_episodes, 3),
        ):
            check_whole(name, value, least)
        for name, flag in (("by_region", by_region), ("wander", wander)):
            if not isinstance(flag, bool):
                raise TypeError(f"{name} = {flag!r} must be True or False.")
        for name, factor, low, high in (
            ("margin", margin, 0.0, np.inf),
            ("shrink", shrink, 0.0, 1.0),
            ("grow", grow, 1.0, np.inf),
            ("smallest_step", smallest_step, 0.0, 1.0),
            ("significance", significance, 0.0, 0.5),
        ):
            check_between(name, factor, low, high)
        self.shrink, self.grow, self.smallest_step = shrink, grow, smallest_step
        self.record = None if record is None else Path(record)
        self.trials: SimulatorAcceptance | PlantAcceptance
        if env is None:
            self.trials = PlantAcceptance(trial_episodes, significance)
        else:
            final = 10 * fresh if final is None else final
            self.trials = SimulatorAcceptance(
                env, n_starts, fresh, final, seed, every, margin, by_region, patience, wander
            )

    @property
    def decisions(self) -> list[Decision]:
        """All decisions so far, those before a resumed run included."""
        return self.state.decisions

    @property
    def state(self) -> GuardState:
        """What has been accepted, and on which evidence."""
        state = getattr(getattr(self, "model", None), "guard_state", None)
        if not isinstance(state, GuardState):
            raise RuntimeError(
                "The guard has no state yet: pass it to learn, as callback=guard, before asking."
            )
        return state

    def _init_callback(self) -> None:
        check_not_nested(self)
        policy = self.model.policy
        if not isinstance(policy, YannPolicy):
            raise TypeError(
                "ImprovementGuard compares a YannPolicy with its MPC; the policy of this model is "
                f"{type(policy).__name__}."
            )
        self.policy = policy
        watch_buffer(self.model)
        untrained = policy.actor.mu.network.is_zero()
        self._mpc = ActorCheckpoint.of(policy) if untrained else None

    def _on_training_start(self) -> None:
        check_not_nested(self)
        self.interrupted = False
        self.trials.start(self)
        known = getattr(self.model, "guard_state", None)
        if known is None or known.settings != self.trials.settings:
            self._start_afresh(known)
        elif not self.trials.still_holds(self):
            warnings.warn(
                f"The guard's env {self.trials.settings['env']} does not play the episodes that "
                "the guard's evidence is from: it is another simulator of that name. The policies "
                "are tried anew.",
                stacklevel=2,
            )
            self._start_afresh(known)
        self._handler = install(self.model, self.leave_accepted, sys._getframe())
        self.policy.actor_step = self.state.step
        if self.record is not None:
            write_csv(self.record, self.decisions)

    def _start_afresh(self, known: GuardState | None) -> None:
        """Gather first evidence; where that fails, leave everything as it was."""
        present = ActorCheckpoint.of(self.policy)
        state = GuardState(self.trials.settings, present, evidence=None)
        if known is not None:  # other starts or another plant: the policies are tried anew
            state.decisions, state.episodes = [*known.decisions], known.episodes
        self.model.guard_state = state  # type: ignore[attr-defined]
        try:
            self.trials.first_evidence(self, known)
        except BaseException:
            present.restore(self.policy)
            self.model.guard_state = known  # type: ignore[attr-defined]
            raise

    def _on_rollout_start(self) -> None:
        self.trials.before_steps(self)

    def _on_step(self) -> bool:
        self.state.episodes += int(np.sum(self.locals["dones"]))
        self.trials.step(self)
        return True

    def _on_training_end(self) -> None:
        self.interrupted = False  # the Zoo ends training after Ctrl-C as well
        self.trials.end(self)
        restore_accepted(self.model)
        if self._handler is not None:
            self._handler.remove()

    def leave_accepted(self) -> None:
        """Leave the accepted policy where `learn` is about to be ended, wherever it is."""
        if self.before_trial is not None:
            self.state.accepted, self.state.evidence, self.state.passed = self.before_trial
        self.interrupted = True
        restore_accepted(self.model)

    # What the trials call.

    def accept(self, evidence: Any, checkpoint: ActorCheckpoint | None = None) -> None:
        """Make the present policy the accepted one; its checkpoint may be at hand already."""
        self.state.accepted = ActorCheckpoint.of(self.policy) if checkpoint is None else checkpoint
        self.state.evidence = evidence

    @property
    def mpc(self) -> ActorCheckpoint:
        """The MPC itself, with an optimizer as new."""
        if self._mpc is None:
            with preserve_rng():  # building an actor draws weights
                actor = self.policy.make_actor()
            optimizer = {**self.policy.actor.optimizer.state_dict(), "state": {}}
            self._mpc = ActorCheckpoint.of_parts(actor.state_dict(), optimizer)
        return self._mpc

    def decide(self, decision: Decision) -> None:
        """Set the step, and write a decision to the record, the logger and the screen."""
        step = self.state.step
        if decision.verdict == "accepted":
            step = min(1.0, step * self.grow)
        elif decision.verdict == "rejected" and decision.returned:
            step = max(min(self.smallest_step, step), step * self.shrink)
        self.state.step = self.policy.actor_step = step
        decision = replace(decision, step=step)
        self.decisions.append(decision)
        for name in ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step"):
            self.logger.record(f"guard/{name}", getattr(decision, name))
        rejected = sum(each.verdict == "rejected" for each in self.decisions)
        self.logger.record("guard/rejected", rejected)
        self.logger.record("guard/accepted", len(self.decisions) - rejected)
        if self.record is not None:
            append_csv(self.record, self.decisions)
        self.logger.dump(self.num_timesteps)  # as EvalCallback does, or the next would replace it
        if self.verbose:
            print(
                f"Episode {decision.episode}: {decision.verdict}"
                + (f" ({decision.reason})" if decision.reason else "")
                + f"; mean cost {decision.accepted_cost:.6g}, MPC {decision.mpc_cost:.6g}"
            )
