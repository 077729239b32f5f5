"""The YANN policy for TQC of sb3-contrib, which registers its name when it is imported."""

from __future__ import annotations

from typing import Any

import torch as th
from sb3_contrib import TQC
from sb3_contrib.tqc.policies import TQCPolicy

from sb3_yann.policy.actor_critic import YannCritic
from sb3_yann.policy.exploring import MaximumEntropy


class QuantileCritic(YannCritic):
    """A critic of quantiles of the return, all of them the law's value at first."""

    def __init__(self, *args: Any, n_quantiles: int, **kwargs: Any) -> None:
        super().__init__(*args, n_outputs=n_quantiles, **kwargs)
        self.quantiles_total = n_quantiles * self.n_critics

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """Return the quantiles, (batch, n_critics, n_quantiles)."""
        return th.stack(super().forward(obs, actions), dim=1)


class YannTQCPolicy(MaximumEntropy, TQCPolicy):  # type: ignore[misc]
    """A TQC policy whose most likely action is that of a linear MPC: see `YannSACPolicy`."""

    ALGORITHMS = (TQC,)
    CRITIC = QuantileCritic
    THEIRS = "n_critics", "n_quantiles"


TQC.policy_aliases["YannPolicy"] = YannTQCPolicy
