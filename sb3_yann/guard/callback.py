"""The callback that is passed to `learn`: it tries candidates, and restores what is accepted."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann._progress import say
from sb3_yann._validation import check_bool, check_int, check_options, check_path, check_range, warn
from sb3_yann.audit.reward import CostAudit
from sb3_yann.compare import AcceptanceRule
from sb3_yann.env_pool import EnvPool, Source, as_source, name_of, require_like_training
from sb3_yann.evaluation.plots import plot_decisions
from sb3_yann.guard.decide import GuardSettings, Player, decide, decide_at_end
from sb3_yann.guard.start import (
    InterruptHandler,
    all_callbacks,
    check_place,
    first_evidence,
    still_holds,
    warn_of_place,
    warn_of_rare_trials,
)
from sb3_yann.guard.state import Decision, GuardState, Record, restore_accepted, summary_of
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.observations import require_same_statistics
from sb3_yann.policy.policies import require_problem_of_twin, require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import LONG_EPISODE, preserve_rng
from sb3_yann.twin.plant_twin import PlantTwin

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACCEPTED_FILE = "accepted_model.zip"


@dataclass(frozen=True)
class StepSize:
    """How decisions scale the actor's learning rate.

    Parameters
    ----------
    shrink : float, default 0.5
        Factor after the accepted policy has been restored.
    grow : float, default 1.5
        Factor after an acceptance. The product never exceeds 1.
    smallest : float, default 0.1
        The product never falls below this.

    Examples
    --------
    >>> from sb3_yann import StepSize
    >>> StepSize(shrink=0.3).grow
    1.5
    """

    shrink: float = 0.5
    grow: float = 1.5
    smallest: float = 0.1

    def __post_init__(self) -> None:
        check_range("shrink", self.shrink, 0, 1)
        check_range("grow", self.grow, 1, np.inf)
        check_range("smallest", self.smallest, 0, 1)

    def after(self, step: float, decision: Decision) -> float:
        """Return the factor of the actor's learning rate after a decision."""
        if decision.verdict == "accepted":
            return min(1.0, step * self.grow)
        if decision.verdict == "rejected" and decision.restored:
            return max(min(self.smallest, step), step * self.shrink)
        return step


class ImprovementGuard(BaseCallback):
    """Keeps only what is no worse than the MPC; restores the accepted policy otherwise.

    When `learn` returns, or Ctrl-C ends it, the model is the accepted policy. Until then it is a
    candidate, also after another exception and in the zips of a CheckpointCallback:
    :func:`restore_accepted` gives it the accepted policy.

    Candidates, accepted policy and MPC play the same seeded starts in a simulator. Where there is
    none, use :class:`Commissioning`. ``docs/guard.md`` says when a candidate is refused. A refusal
    restores actor, target actor and the actor's optimizer bit for bit, at once or when ``patience``
    is over. No random numbers are drawn. The state travels with the model.

    Parameters
    ----------
    env : str, gymnasium.Env, callable or PlantTwin
        The simulator: an id, a function that makes an env, or an env other than the training env.
        The first two play all starts side by side. Of a twin all members are played, start by
        start.
    n_eval_episodes : int, default 40
        Number of seeded starts. A candidate plays as many of them as it takes: five, then twice as
        many each, until it is surely better than the accepted policy, or hopeless.
    n_new_starts : int, default 20
        Number of further starts that confirm a policy before it is accepted, 0 for none; as many as
        it takes. Where it loses there, the ten hardest join the known starts, and others follow.
    n_final_starts : int, default 10 * n_new_starts
        Number of new starts that confirm the accepted policy when training ends: forty, and more
        until its gain is sure. A strict rule plays all.
    seed : int, default 1_000_000
        The seed of the first start; the others follow.
    eval_freq : int, default 1
        Training episodes from one candidate to the next.
    patience : int, default 5
        Refusals in a row until the accepted policy is restored. Until then the candidate plays on.
    keep_if_worse : bool, default False
        Whether patience holds where the mean cost is above the MPC's, or a bound of its problem is
        exceeded farther. After a violation that the env reports, as `StageCost` does each excess,
        there is none in any case.
    rule : AcceptanceRule or mapping, optional
        When a candidate counts as no worse.
    step_size : StepSize or mapping, optional
        How decisions scale the actor's learning rate.
    log_path : path-like, optional
        A CSV file of all decisions, up to date after each one; ``guard.decisions`` has them too.
        What it held of another run is kept beside it, in a file with a number. Training goes on
        where it cannot be written, with a warning.
    save_path : path-like, optional
        A folder for ``accepted_model.zip``, the model with the policy accepted last: as it was when
        that was accepted, at the end as `learn` leaves it. The default is ``best_model_save_path``
        of an EvalCallback of the same `learn`, whose own ``best_model.zip`` is a candidate that no
        guard has accepted; none without one.
    verbose : int, default 0
        1 prints each decision.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range. When training starts: if the policy is no YannPolicy, or
        the simulator cannot compare policies.

    Examples
    --------
    >>> from sb3_yann import ImprovementGuard
    >>> guard = ImprovementGuard("CSTR-v0", n_new_starts=100, rule={"margin": 0.02})
    >>> guard.step_size
    StepSize(shrink=0.5, grow=1.5, smallest=0.1)

    ``model.learn(20_000, callback=[NoActionNoise(), guard])`` trains under guard.
    """

    model: OffPolicyAlgorithm
    twin: PlantTwin | None = None
    player: Player
    _has_begun = False
    _audit: CostAudit | None = None
    _steps: Any = 0  # of each env's present episode, in this learn

    def __init__(  # noqa: PLR0913 (settings of a user, each by its name)
        self,
        env: Source | PlantTwin,
        *,
        n_eval_episodes: int = 40,
        n_new_starts: int = 20,
        n_final_starts: int | None = None,
        seed: int = 1_000_000,
        eval_freq: int = 1,
        patience: int = 5,
        keep_if_worse: bool = False,
        rule: AcceptanceRule | Mapping[str, Any] = AcceptanceRule(),  # noqa: B008 (frozen)
        step_size: StepSize | Mapping[str, Any] = StepSize(),
        log_path: str | PathLike[str] | None = None,
        save_path: str | PathLike[str] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if isinstance(env, PlantTwin):
            env.require_trust()
            # The seed of an episode names a member: all of them are played.
            self.twin = env
            env = env.env
        if not (isinstance(env, str | gym.Env) or callable(env)):
            raise TypeError(
                f"env = {env!r} must be a simulator of the plant: the id of an environment, a "
                "gymnasium.Env, a function that makes one, or a PlantTwin. On a plant without a "
                "simulator use Commissioning (docs/improve.md)."
            )
        as_source(env)  # a name that cannot be imported is an error here
        self.log_path = check_path("log_path", log_path)
        self.save_path = check_path("save_path", save_path)
        if self.log_path is not None and self.log_path.is_dir():
            raise ValueError(f"log_path = {log_path!r} is a folder; name a file in it.")
        if self.save_path is not None and self.save_path.is_file():
            raise ValueError(f"save_path = {save_path!r} is a file; name a folder.")
        check_int("n_eval_episodes", n_eval_episodes)
        check_int("n_new_starts", n_new_starts, 0)
        n_final = 10 * n_new_starts if n_final_starts is None else n_final_starts
        check_int("seed", seed, 0)
        self.env = env
        self.step_size = check_options("step_size", step_size, StepSize)
        self.settings = GuardSettings(
            env=name_of(env),
            seeds=range(seed, seed + n_eval_episodes),
            n_new_starts=n_new_starts,
            n_final_starts=check_int("n_final_starts", n_final, 0),
            eval_freq=check_int("eval_freq", eval_freq),
            patience=check_int("patience", patience),
            keep_if_worse=check_bool("keep_if_worse", keep_if_worse),
            rule=check_options("rule", rule, AcceptanceRule),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Leave out of a copy what one `learn` shows, and what hears of its Ctrl-C."""
        of_learn = {"locals", "globals", "_handler", "_audit"}
        kept = {name: each for name, each in vars(self).items() if name not in of_learn}
        return kept | {"locals": {}, "globals": {}}

    @property
    def state(self) -> GuardState:
        """What has been accepted, and on which evidence."""
        state = getattr(getattr(self, "model", None), "guard_state", None)
        if not isinstance(state, GuardState):
            raise RuntimeError("The guard has no state yet: pass it to learn, as callback=guard.")
        return state

    @property
    def decisions(self) -> list[Decision]:
        """All decisions so far, those before a resumed run included."""
        return self.state.decisions

    def summary(self) -> str:
        """Return some lines: what is accepted, what was refused most often, and what may help."""
        return summary_of(self.state, self.player.policy, self.settings.eval_freq)

    @property
    def steps(self) -> int:
        """Steps of its simulator in all runs, those of its checks included."""
        return self.player.steps

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the mean cost of each candidate by the verdict on it; return the axes.

        Without ``axes`` they are a new figure's.
        """
        return plot_decisions(self.decisions, axes)

    def _init_callback(self) -> None:
        self.locals = {}  # those of an earlier `learn` say nothing of this one
        check_place(self)
        policy = require_yann_policy(self.model.policy, "ImprovementGuard")
        if self.twin is not None:
            require_problem_of_twin(policy, self.twin.problem)
            if policy.observation is not None:
                raise ValueError(
                    "The twin shows theta, but the model's policy makes theta of its observations. "
                    "Guard it in a simulator that shows those, or improve it with "
                    "improve(model, twin)."
                )
        watch_buffer(self.model)
        known = getattr(self.model, "guard_state", None)
        with preserve_rng():  # building an actor draws weights; a run that goes on has the same
            mpc = known.evidence.mpc if known else ActorCheckpoint.of_mpc(policy)
        self.player = Player(self.model, policy, EnvPool(self.env), mpc)
        self._saved: ActorCheckpoint | None = None

    def _on_training_start(self) -> None:
        check_place(self)
        require_same_statistics(self.model)
        warn_of_place(self, sys._getframe())
        warn_of_rare_trials(self.model, self.settings.eval_freq)
        self._has_begun = False
        self._steps = 0
        self._final: ActorCheckpoint | None = None
        player = self.player
        settings = self.settings
        with preserve_rng():
            require_like_training(self.env, self.model.get_env(), f"The guard's env {settings.env}")
        known: GuardState | None = getattr(self.model, "guard_state", None)
        refusals: list[Decision] = []
        goes_on = False
        if known is not None and known.settings == settings.of_evidence:
            player.max_input_step = known.max_input_step
            player.offset = known.offset
            goes_on = still_holds(known.evidence, player)
            if not goes_on:
                warn(
                    f"The guard's env {settings.env} does not play the episodes of before: it is "
                    "another simulator of that name. The policies are tried anew."
                )
        player.steps += known.steps if known else 0
        if not goes_on:
            player.max_input_step = None
            evidence, leading, refusals = first_evidence(player, settings, known)
            state = GuardState(settings.of_evidence, evidence, player.max_input_step)
            state.offset = player.offset
            if known is not None:  # other starts or another plant: what was decided stays
                state.decisions = [*known.decisions]
                state.episodes = known.episodes
            self.model.guard_state = state  # type: ignore[attr-defined]
            leading.restore(player.policy)
        self._handler = InterruptHandler(self.model, self._leave_accepted, sys._getframe())
        player.policy.actor_step = self.state.step
        player.policy.guarded = True
        self._has_begun = True
        self._record = None if self.log_path is None else Record(self.log_path, self.decisions)
        for each in refusals:
            self._log(each)
        self._folder = self._folder_of_accepted()
        self._save_accepted()
        self._begin_audit()

    def _begin_audit(self) -> None:
        """Begin to compare the first rewards with the stage cost, unless somebody does or did."""
        passed = all_callbacks(self.locals.get("callback"))
        if self._audit is None and not any(isinstance(each, CostAudit) for each in passed):
            self._audit = CostAudit()
            self._audit.order_checked = True
            self._audit.init_callback(self.model)
            self._audit.on_training_start(self.locals, self.globals)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Pass on what SB3 knows at this step."""
        if self._audit is not None:
            self._audit.update_locals(locals_)

    def _on_step(self) -> bool:
        if self._audit is not None and self._audit.finding is None:
            self._audit.on_step()
            found: Any = self._audit.finding
            if found is not None and found.matches and not self.player.pays_cost:
                warn(
                    "The first steps of training pay minus the cost of the MPC, and the guard's "
                    f"env {self.settings.env} pays something else, by which policies are compared. "
                    "Give it the env of the training, with the same StageCost; if it has it, its "
                    "reward holds more where its starts lead. The guard itself counts what soft "
                    "bounds cost."
                )
        dones = self.locals["dones"]
        state = self.state
        state.episodes += int(np.sum(dones))
        self._steps = np.where(dones, 0, self._steps + 1)
        if np.any(self._steps == LONG_EPISODE):
            warn(
                f"An episode of the training env has not ended after {LONG_EPISODE} steps, and the "
                "guard decides at the ends of episodes. Give it a limit, by "
                "gymnasium.wrappers.TimeLimit."
            )
        last = state.last_trial
        if np.any(dones) and (last is None or state.episodes - last >= self.settings.eval_freq):
            state.last_trial = state.episodes
            self._try_candidate()
        self._save_accepted()
        return True

    def _try_candidate(self) -> None:
        """Accept the present policy, whole or in part, or refuse it.

        Until it is decided, the state is that of before: that is left where Ctrl-C cuts this off.
        """
        state = self.state
        policy = self.player.policy
        if state.accepted.is_actor_of(policy):
            return
        decided = decide(state.evidence, ActorCheckpoint.of(policy), self.player, self.settings)
        if decided is None:
            return
        state.evidence, decision = decided
        if decision.restored:
            state.accepted.restore(policy)
        self._log(decision)

    def _log(self, decision: Decision) -> None:
        """Set the step size; write a decision to the record, to the logger and to the screen."""
        state = self.state
        logger = self.model.logger
        step = self.step_size.after(state.step, decision)
        state.step = self.player.policy.actor_step = step
        decision = replace(
            decision, timestep=self.model.num_timesteps, episode=state.episodes, step=step
        )
        state.decisions.append(decision)
        names = ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step")
        shown = {name: getattr(decision, name) for name in names}
        for who, change in zip(("candidate", "accepted"), decision.changes, strict=True):
            shown[f"{who}_change_percent"] = 100 * change
        shown["rejected"] = sum(each.verdict == "rejected" for each in state.decisions)
        shown["accepted"] = len(state.decisions) - shown["rejected"]
        for name, value in shown.items():
            if math.isfinite(value):  # that of a candidate that could not be played is not
                logger.record(f"guard/{name}", value)
        logger.dump(self.model.num_timesteps)  # as EvalCallback does, or the next would replace it
        if self.verbose:
            say(decision)
        if self._record is not None:
            self._record.write(state.decisions)

    def _leave_accepted(self) -> None:
        """Restore the accepted policy where Ctrl-C is about to end `learn`, also in a trial."""
        self.player.interrupted = True
        self.player.policy.guarded = False
        self.state.steps = self.player.steps
        restore_accepted(self.model)

    def _folder_of_accepted(self) -> Path | None:
        """Return where to save; warn of a callback whose best model is a candidate."""
        for each in all_callbacks(self.locals.get("callback")):
            if folder := getattr(each, "best_model_save_path", None):
                instead = (self.save_path or Path(folder)) / ACCEPTED_FILE
                warn(
                    f"The best_model.zip that {type(each).__name__} keeps in {folder} is a "
                    f"candidate, which no guard has accepted. Load {instead} instead, or the model "
                    "that learn leaves behind."
                )
                return instead.parent
        return self.save_path

    def _save_accepted(self) -> None:
        """Save the model with the accepted policy, if it is another one than was saved last."""
        self.state.steps = self.player.steps
        accepted = self.state.accepted
        policy = self.player.policy
        if self._folder is None or accepted is self._saved:
            return
        path = self._folder / ACCEPTED_FILE
        own = ActorCheckpoint.of(policy)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as part:
                accepted.restore(policy)
                self.model.save(part)
            self._saved = accepted
        except OSError as error:
            self._saved = None
            warn(f"{path} could not be written ({error}). Training goes on.")
        finally:
            if not self.player.interrupted:
                own.restore(policy)

    def _on_training_end(self) -> None:
        # The Zoo ends training after Ctrl-C as well, also before there is anything accepted.
        if not self._has_begun:
            return
        self.player.interrupted = False
        if self._audit is not None and self._audit.finding is None:
            self._audit.on_training_end()
        try:
            self._end()
        finally:
            self.player.policy.guarded = False
            restore_accepted(self.model)
            self._saved = None  # an early one, the MPC's own of step 0, knows nothing of the run
            self._save_accepted()
            self.player.envs.close()
            self._handler.remove()

    def _end(self) -> None:
        """Try the last candidate, and confirm what is accepted on the final new starts."""
        state = self.state
        settings = self.settings
        # There is no later: a candidate that is refused now is not kept.
        state.evidence = replace(state.evidence, rejections=settings.patience - 1)
        try:
            self._try_candidate()
        finally:
            state.evidence = replace(state.evidence, rejections=0)
        if state.accepted is self._final:  # the Zoo ends its first callback a second time
            return
        state.evidence, refusal = decide_at_end(state.evidence, self.player, settings)
        self._final = state.accepted
        state.accepted.restore(self.player.policy)
        if refusal is not None:
            self._log(refusal)
