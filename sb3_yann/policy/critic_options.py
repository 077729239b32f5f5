"""What a user may choose of the critic, checked once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_yann._validation import check_choice, check_number, check_options, check_positive
from sb3_yann.networks.prediction import PredictionModel

KINDS = ("afterstate", "state_action")


@dataclass(frozen=True)
class CriticOptions:
    """Options of the critic, for ``policy_kwargs={"critic": ...}``.

    Parameters
    ----------
    kind : {"afterstate", "state_action"}, default "afterstate"
        What is learnt: the value of the predicted next state (:class:`AfterstateValue`), or the
        paper's function of state and action (:class:`QuadraticStateActionValue`).
    prediction_model : callable, optional
        ``(theta, u) -> next theta`` for the afterstate critic, differentiable, of float64 tensors
        (batch, n) and (batch, m) in physical units. The default is the MPC's ``A theta + B u``.
    value_scale : float, optional
        Factor of the afterstate critic's network: the order of the changes of V to be learnt. The
        default is the mean stage cost of what is learnt from while the actor is still the MPC
        (``critic_warmup``), over ``1 - gamma``, or 0.01 where that is more.
    reward_scale, reward_offset : float, default 1 and 0
        The env's reward is ``reward_scale * (-c) + reward_offset`` for the problem's stage cost c.
        :class:`CostAudit` finds these numbers.

    Examples
    --------
    >>> CriticOptions(reward_scale=0.01, value_scale=10.0).kind
    'afterstate'
    """

    kind: str = "afterstate"
    prediction_model: PredictionModel | None = None
    value_scale: float | None = None
    reward_scale: float = 1.0
    reward_offset: float = 0.0

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, KINDS)
        if self.prediction_model is not None and not callable(self.prediction_model):
            raise TypeError(
                f"prediction_model = {self.prediction_model!r} must be a function of tensors "
                "(theta, u) that returns the next theta, or None for the linear model."
            )
        if self.prediction_model is not None and self.kind == "state_action":
            raise ValueError("prediction_model is for kind='afterstate', not for 'state_action'.")
        if self.value_scale is not None:
            check_positive(
                "value_scale", self.value_scale, "It multiplies the network, or is None."
            )
        check_positive("reward_scale", self.reward_scale, "Give 1 for the cost as it is.")
        check_number("reward_offset", self.reward_offset)

    @property
    def scales_itself(self) -> bool:
        """Whether the scale of the values comes from what is learnt from."""
        return self.value_scale is None and self.kind == "afterstate"

    def offset_of_return(self, gamma: float) -> float:
        """Return what ``reward_offset`` adds up to; ValueError if that is no finite number."""
        if self.reward_offset == 0:
            return 0.0
        if not gamma < 1:
            raise ValueError(f"reward_offset = {self.reward_offset!r} needs a discount below 1.")
        return float(self.reward_offset) / (1 - gamma)


def as_critic_options(critic: str | CriticOptions | Mapping[str, Any]) -> CriticOptions:
    """Return the options of a critic from its kind, a mapping of some of them, or themselves."""
    if isinstance(critic, CriticOptions | Mapping):
        return check_options("critic", critic, CriticOptions)
    return CriticOptions(check_choice("critic", critic, KINDS))
