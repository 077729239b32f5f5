"""The policy that a model holds while it is commissioned: the accepted one, within its bound."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.policy.policies import require_yann_policy


class Incumbent:
    """A model's policy, its bound, and the MPC that it can always return to.

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
            self._mpc = self.policy.make_actor().state_dict()

    @property
    def has_learnt(self) -> bool:
        """Whether it differs from the MPC anywhere."""
        return not self.policy.actor.mu.network.is_zero()

    def limit(self, max_correction: float | None) -> None:
        """Bound it, also in what :meth:`save` of the model writes."""
        self.policy.limit_correction(max_correction)
        self.model.policy_kwargs = {**self.model.policy_kwargs, "max_correction": max_correction}

    def give_back(self) -> None:
        """Make it the MPC."""
        self.policy.actor.load_state_dict(self._mpc)
        self.policy.actor_target.load_state_dict(self._mpc)

    @contextmanager
    def unless_cut_off(self) -> Iterator[None]:
        """Leave it as it was if an error or Ctrl-C cuts a decision off."""
        held, bound = ActorCheckpoint.of(self.policy), self.policy.max_correction
        try:
            yield
        except BaseException:
            held.restore(self.policy)
            self.limit(bound)
            raise
