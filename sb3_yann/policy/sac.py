"""The YANN policy for SAC."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.sac.policies import SACPolicy

from sb3_yann.policy.spread import Explores


class MaximumEntropy(Explores):
    """What SAC and TQC need besides: an entropy that their defaults keep as small as it begins.

    The coefficient starts where the linear model's price of the spread balances its entropy, and
    the target is the entropy at the start; a number that the user gives stays. The first actions
    are drawn as all others are, where SB3 draws ``learning_starts`` of them from the whole range.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        algorithm: Any = None if self._algorithm is None else self._algorithm()
        if algorithm is not None:
            algorithm.learning_starts = 0
        if algorithm is not None and algorithm.ent_coef == "auto":
            algorithm.ent_coef = f"auto_{self.balanced_entropy_coefficient():.6e}"
        if algorithm is not None and algorithm.target_entropy == "auto":
            m = self.problem.model.n_inputs
            algorithm.target_entropy = m * (0.5 + math.log(2 * self.initial_std * math.tau**0.5))

    def balanced_entropy_coefficient(self) -> float:
        """Return the coefficient for which the initial spread is best on the linear model.

        There it costs ``u' M u`` by the critic's quadratic form, and entropy grows by its
        logarithm: Haarnoja et al., *Soft Actor-Critic Algorithms and Applications*, 2018.
        """
        m = self.problem.model.n_inputs
        curvature = np.diag(self.problem.state_action_matrix(self.gamma))[-m:]
        each = curvature * (2 * self.initial_std * self.problem.u_half) ** 2
        return float(2 * self.critic_options.reward_scale * max(each.mean(), 1e-12))

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        if not deterministic:
            self.says_that_it_explores()
        actions: th.Tensor = self.actor(observation, deterministic)
        return actions


class YannSACPolicy(MaximumEntropy, SACPolicy):  # type: ignore[misc]
    """A SAC policy whose most likely action is that of a linear MPC, exactly.

    ``SAC("YannPolicy", env)``. The critic starts as the law's value without the entropy term, which
    shifts it by a number that is the same for all actions. ``learning_starts`` becomes 0:
    ``critic_warmup`` says how long the actor waits.

    Parameters
    ----------
    initial_std : float, default 0.02
        Standard deviation of the drawn actions, as a share of the input range; it is learnt.
    simulator : bool, default False
        Whether the env is one: then nothing is said of learning without an ImprovementGuard.
    *args, **kwargs
        As those of :class:`YannPolicy`.

    Examples
    --------
    >>> model = SAC("YannPolicy", "CSTR-v0", policy_kwargs={"simulator": True}, device="cpu")
    >>> theta = np.zeros(4, dtype=np.float32)
    >>> law = model.policy.problem.explicit()
    >>> bool(np.allclose(model.predict(theta, deterministic=True)[0], law(theta)))
    True
    """

    ALGORITHMS = (SAC,)


SAC.policy_aliases["YannPolicy"] = YannSACPolicy
