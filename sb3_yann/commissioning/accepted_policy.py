"""The policy that a model holds while it is commissioned: the accepted one, within its bound."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann.policy.checkpoint import (
    ActorCheckpoint,
    all_or_nothing,
    restore_whole,
    whole_policy,
)
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.rollout import preserve_rng


class AcceptedPolicy:
    """A model's policy, its bound, and the MPC that it can always return to.

    A policy that the model has learnt before is nobody's yet: it waits as ``candidate``, and the
    model is the MPC.

    Parameters
    ----------
    model : DDPG or TD3
        With a :class:`YannPolicy`.
    """

    def __init__(self, model: OffPolicyAlgorithm) -> None:
        if not isinstance(model, OffPolicyAlgorithm):
            raise TypeError(f"model = {model!r} must be a DDPG or TD3 model.")
        self.model, self.policy = model, require_yann_policy(model.policy, "Commissioning")
        with preserve_rng():  # building an actor draws weights
            mpc = self.policy.make_actor().state_dict()
        self._first = {name: each.clone() for name, each in self.policy.state_dict().items()}
        for actor in ("actor", "actor_target"):
            self._first |= {f"{actor}.{name}": each for name, each in mpc.items()}
        self.candidate: ActorCheckpoint | None = None
        self._kept: tuple[ActorCheckpoint, float | None] | None = None
        self._shown: tuple[ActorCheckpoint, Any] | None = None
        if self.has_learnt:
            self.candidate = ActorCheckpoint.of(self.policy)
            self.give_back()
        self.hold()

    @property
    def has_learnt(self) -> bool:
        """Whether it differs from the MPC anywhere."""
        return not self.policy.actor.mu.network.is_zero()

    def limit(self, max_correction: float | None) -> None:
        """Bound it, for good: a model that is saved keeps it."""
        self.policy.limit_correction(max_correction)

    def give_back(self) -> None:
        """Make it the MPC, with the critic that the model began with."""
        self.policy.load_state_dict(self._first)
        for network in (self.policy.actor, self.policy.critic):
            network.optimizer.state.clear()  # what other weights were moved by

    def take_candidate(self) -> None:
        """Make it what the model had learnt before, if that still waits, to be tried."""
        if self.candidate is not None:
            self.candidate.restore(self.policy)
            self.candidate = None

    def keep(self, kept: bool) -> None:
        """Take it for the one that the plant has confirmed; or forget which one that was."""
        self._kept = (ActorCheckpoint.of(self.policy), self.policy.max_correction) if kept else None

    def return_to_kept(self) -> None:
        """Make it the one that the plant has confirmed."""
        assert self._kept is not None
        self._kept[0].restore(self.policy)
        self.limit(self._kept[1])

    def show(self) -> None:
        """Make it the one that the plant has confirmed, else the MPC, while no episode is played.

        What is on trial goes on from :meth:`restore`.
        """
        if self._shown is not None:
            return
        whole = whole_policy(self.policy), self.policy.max_correction
        if self._kept is None:
            self.give_back()
        else:
            self.return_to_kept()
        self._shown = ActorCheckpoint.of(self.policy), whole

    def hold(self) -> None:
        """Take it for the accepted one from here on."""
        self._shown = None
        self._held = ActorCheckpoint.of(self.policy), self.policy.max_correction

    def restore(self) -> None:
        """Make it the accepted one again, with a warning where something has changed it."""
        held, bound = self._held
        if self._shown is not None:
            shown, (whole, its_bound) = self._shown
            self._shown = None
            if shown.is_actor_of(self.policy):
                restore_whole(self.policy, whole)
                self.limit(its_bound)
        if held.is_actor_of(self.policy) and bound == self.policy.max_correction:
            return
        held.restore(self.policy)
        self.limit(bound)
        warnings.warn(
            "The model's actor is not the one that was accepted: that one is restored. Train "
            "another copy of the model, not the one that is being commissioned.",
            stacklevel=2,
        )

    @contextmanager
    def unless_cut_off(self) -> Iterator[None]:
        """Leave it as it was if an error or Ctrl-C cuts a decision off."""
        bound = self.policy.max_correction
        candidate = self.candidate
        kept = self._kept
        try:
            with all_or_nothing(self.policy):
                yield
        except BaseException:
            self.limit(bound)
            self.candidate = candidate
            self._kept = kept
            raise
        self.hold()
