"""What the guard's functions act on: the policy, what is accepted, and where to play."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann._validation import check_type
from sb3_yann.evaluation.episodes import EnvPool, Source
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.options import StepSize
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.state import Decision, GuardState, Verdict, log_last
from sb3_yann.policy.policies import YannPolicy

ACCEPTED = "accepted_model.zip"
"""The file of the model with the accepted policy."""


@dataclass
class GuardSession:
    """One model under guard, during one `learn`.

    Attributes
    ----------
    model : OffPolicyAlgorithm, in training
    policy : YannPolicy, the model's
    simulator : gymnasium.Env, str or callable, where candidates play
    step_size, log_path, verbose : StepSize, Path or None and int, as in :class:`ImprovementGuard`
    interrupted : bool, whether Ctrl-C has restored the accepted policy: nothing else may be then
    log_lacks_rows : bool, whether decisions could not be written to the log
    before_trial : tuple or None, what was accepted, its evidence and ``passed`` before a trial
    """

    model: OffPolicyAlgorithm
    policy: YannPolicy
    simulator: Source
    step_size: StepSize
    log_path: Path | None
    verbose: int
    interrupted: bool = False
    log_lacks_rows: bool = False
    before_trial: tuple[ActorCheckpoint, Any, list[Any]] | None = None

    def __post_init__(self) -> None:
        known = getattr(self.model, "guard_state", None)
        if known is not None and known.mpc is not None:  # a run that goes on has the same weights
            self.mpc = known.mpc
        elif self.policy.actor.mu.network.is_zero():
            self.mpc = ActorCheckpoint.of(self.policy)

    @cached_property
    def envs(self) -> EnvPool:
        """The envs of the simulator, kept from trial to trial."""
        return EnvPool(self.simulator)

    @cached_property
    def mpc(self) -> ActorCheckpoint:
        """The MPC itself, with an optimizer as new."""
        with preserve_rng():  # building an actor draws weights
            actor = self.policy.make_actor()
        optimizer = {**self.policy.actor.optimizer.state_dict(), "state": {}}
        return ActorCheckpoint.of_parts(actor.state_dict(), optimizer)

    @property
    def state(self) -> GuardState:
        """What is accepted, on which evidence."""
        return self.model.guard_state  # type: ignore[attr-defined, no-any-return]

    @contextmanager
    def playing(self, checkpoint: ActorCheckpoint) -> Iterator[YannPolicy]:
        """Yield the policy with the actor of a checkpoint; its own actor is back afterwards."""
        own = {key: each.clone() for key, each in self.policy.actor.state_dict().items()}
        try:
            self.policy.actor.load_state_dict(checkpoint.actor)
            yield self.policy
            if self.interrupted:  # and a simulator has swallowed it
                raise KeyboardInterrupt
        finally:
            if not self.interrupted:
                self.policy.actor.load_state_dict(own)

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Undo what was accepted within, if an error or Ctrl-C cuts it off.

        A policy on trial stands in the place of the accepted one until its trial is over.
        """
        state = self.state
        before = self.before_trial = state.accepted, state.evidence, [*state.passed]
        try:
            yield
        except BaseException:
            state.accepted, state.evidence, state.passed = before
            raise
        finally:
            self.before_trial = None

    def close(self) -> None:
        """Close the envs that were made; one that was given is the caller's."""
        if not isinstance(self.simulator, gym.Env):
            self.envs.close()

    def leave_accepted(self) -> None:
        """Restore the accepted policy where Ctrl-C is about to end `learn`, also in a trial."""
        if self.before_trial is not None:
            self.state.accepted, self.state.evidence, self.state.passed = self.before_trial
        self.interrupted = True
        restore_accepted(self.model)

    def save_accepted(self, path: Path) -> None:
        """Save the model with the accepted policy, as a whole; it goes on with its own."""
        own = ActorCheckpoint.of(self.policy)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with atomic_write(path) as part:
                self.state.accepted.restore(self.policy)
                self.model.save(part)
        finally:
            if not self.interrupted:
                own.restore(self.policy)

    def has_learned(self, checkpoint: ActorCheckpoint) -> bool:
        """Return whether the networks of a checkpoint correct the MPC anywhere."""
        with self.playing(checkpoint) as policy:
            return not policy.actor.mu.network.is_zero()

    def seen(self, observations: Any) -> Any:
        """Return observations of the simulator, which is below any VecNormalize, normalized."""
        normalize = self.model.get_vec_normalize_env()
        return observations if normalize is None else normalize.normalize_obs(observations)

    def decide(
        self,
        verdict: Verdict,
        reason: str,
        restored: bool,
        costs: tuple[float, float, float],
        worst_start: float = math.nan,
        regions: tuple[int, ...] = (),
        *,
        share: float,
    ) -> None:
        """Set the step size, and log a Decision.

        Parameters
        ----------
        verdict, reason, restored, worst_start, regions, share
            Fields of the :class:`Decision`.
        costs : triple of float
            Mean costs of the candidate, the policy accepted now and the MPC.
        """
        state, step, steps = self.state, self.state.step, self.model.num_timesteps
        if verdict == "accepted":
            step = min(1.0, step * self.step_size.grow)
        elif verdict == "rejected" and restored:
            step = max(min(self.step_size.smallest, step), step * self.step_size.shrink)
        state.step = self.policy.actor_step = step
        decision = Decision(
            steps,
            state.episodes,
            verdict,
            reason,
            restored,
            *costs,
            worst_start,
            regions,
            step,
            share,
        )
        state.decisions.append(decision)
        written = log_last(
            state.decisions, self.model, self.log_path, self.verbose, self.log_lacks_rows
        )
        self.log_lacks_rows = not written


def restore_accepted(model: BaseAlgorithm) -> None:
    """Give the model the policy that a guard accepted last, bit for bit.

    `learn` does so at its end and after Ctrl-C. Call it after another exception, and for a model
    that was saved during training. A model without a guard is a ValueError.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import ImprovementGuard, NoActionNoise, restore_accepted
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> guard = ImprovementGuard("CSTR-v0", n_starts=2, n_new_starts=2)
    >>> _ = model.learn(1, callback=[NoActionNoise(), guard])
    >>> restore_accepted(model)
    """
    check_type("model", model, BaseAlgorithm, "a DDPG or TD3 model")
    state, policy = getattr(model, "guard_state", None), model.policy
    if not isinstance(state, GuardState) or not isinstance(policy, YannPolicy):
        name = type(model).__name__
        raise ValueError(f"No ImprovementGuard has been at work on this {name}: pass one to learn.")
    state.accepted.restore(policy)
    policy.actor_step = 1.0
