"""An actor that draws its actions around the law, for algorithms that explore by their policy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any

import torch as th
from torch import nn

from sb3_yann._validation import check_bool, check_range
from sb3_yann.control import LinearMPC
from sb3_yann.policy.actor_critic import YannActor
from sb3_yann.policy.policies import NOT_OURS, StartsAsMPC

SMALLEST, LARGEST = math.log(1e-4), math.log(2.0)
"""Bounds of the logarithm of a standard deviation, of actions in [-1, 1]."""
EDGE = 1e-12
"""A quantile stays so far from 0 and 1, where the normal distribution's inverse is not finite."""
HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


class TruncatedNormal:
    """Independent normal distributions, truncated to actions in [-1, 1].

    The most likely action is the center itself, at the bounds too, and the density is finite
    everywhere in between; a tanh would have neither. Formulas: Burkardt, *The Truncated Normal
    Distribution*, 2014, and the inverse of the cumulative distribution to draw with a gradient.

    Parameters
    ----------
    center : Tensor, shape (batch, m)
        In [-1, 1].
    log_std : Tensor, shape (m,)
        Of the normal distributions before they are truncated.

    Examples
    --------
    >>> at_bound = TruncatedNormal(th.ones(1, 1), th.tensor([-3.0]))
    >>> at_bound.mode().item(), bool(at_bound.log_prob(at_bound.mode()).isfinite())
    (1.0, True)
    """

    def __init__(self, center: th.Tensor, log_std: th.Tensor) -> None:
        self.center = center
        # Float64: the tails of float32 end at five standard deviations.
        self.m = center.double()
        self.std = log_std.double().clamp(SMALLEST, LARGEST).exp()
        self.low, self.high = (-1 - self.m) / self.std, (1 - self.m) / self.std
        self.below = th.special.ndtr(self.low)
        self.mass = th.special.ndtr(self.high) - self.below

    def mode(self) -> th.Tensor:
        """Return the center, (batch, m)."""
        return self.center

    def sample(self) -> th.Tensor:
        """Return actions (batch, m), with a gradient by center and spread."""
        quantile = self.below + th.rand_like(self.m) * self.mass
        away = th.special.ndtri(quantile.clamp(EDGE, 1 - EDGE))
        actions: th.Tensor = (self.m + self.std * away).clamp(-1, 1).to(self.center.dtype)
        return actions

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return the logarithm of the density, (batch,), of actions (batch, m)."""
        away = (actions.double() - self.m) / self.std
        each = -0.5 * away**2 - HALF_LOG_TAU - self.std.log() - self.mass.log()
        total: th.Tensor = each.sum(1).to(self.center.dtype)
        return total

    def entropy(self) -> th.Tensor:
        """Return the differential entropy, (batch,)."""
        density = [(-0.5 * each**2 - HALF_LOG_TAU).exp() for each in (self.low, self.high)]
        edges = (self.low * density[0] - self.high * density[1]) / (2 * self.mass)
        each = HALF_LOG_TAU + 0.5 + self.std.log() + self.mass.log() + edges
        total: th.Tensor = each.sum(1).to(self.center.dtype)
        return total


class SpreadActor(YannActor):
    """The YANN actor, whose actions are drawn around what the law and its networks say.

    Parameters
    ----------
    problem : LinearMPC
    initial_std : float
        Standard deviation, as a share of the input range.
    **kwargs
        As those of :class:`YannActor`.
    """

    def __init__(self, problem: LinearMPC, *, initial_std: float, **kwargs: Any) -> None:
        super().__init__(problem, **kwargs)
        self.options["initial_std"] = initial_std
        m = problem.model.n_inputs
        self.log_std = nn.Parameter(th.full((m,), math.log(2 * initial_std), dtype=th.float32))

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """Yield the weights, and the spread."""
        yield from super().parameters(recurse)
        if recurse:
            yield self.log_std

    def distribution(self, obs: th.Tensor) -> TruncatedNormal:
        """Return that of the actions for observations (batch, n_obs)."""
        return TruncatedNormal(super().forward(obs), self.log_std)

    def forward(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """Return the actions in [-1, 1], (batch, m), drawn unless ``deterministic``."""
        return super().forward(obs) if deterministic else self.distribution(obs).sample()

    def action_log_prob(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return drawn actions (batch, m) and the logarithm of their density, (batch,)."""
        distribution = self.distribution(obs)
        actions = distribution.sample()
        return actions, distribution.log_prob(actions)


class Explores(StartsAsMPC):
    """What policies share whose algorithms explore by drawing actions."""

    OWN = "initial_std", "simulator"

    def __init__(
        self,
        *args: Any,
        initial_std: float = 0.02,
        simulator: bool = False,
        use_sde: bool = False,
        **kwargs: Any,
    ) -> None:
        if use_sde:
            raise ValueError(
                "use_sde = True: the spread is one number for each input, initial_std at first."
            )
        self.initial_std = check_range("initial_std", initial_std, 0, 0.5, "(]")
        self.simulator = check_bool("simulator", simulator)
        self.explored = False
        super().__init__(*args, **kwargs)

    @property
    def actor_target(self) -> SpreadActor:  # type: ignore[override]
        """The actor: there is no other."""
        return self.actor  # type: ignore[return-value]

    def make_actor(self, features_extractor: Any = None) -> SpreadActor:
        """Return an actor whose most likely action is the law's."""
        given = {"initial_std": self.initial_std}
        actor: SpreadActor = self._actor(SpreadActor, features_extractor, **given)
        return actor

    def says_that_it_explores(self) -> None:
        """Warn once where nothing says that the plant is a simulator, and no guard is at work."""
        algorithm = None if self._algorithm is None else self._algorithm()
        if self.explored or algorithm is None or algorithm.policy is not self:
            return
        self.explored = True
        if not self.simulator and getattr(algorithm, "guard_state", None) is None:
            name = type(algorithm).__name__
            warnings.warn(
                f"{name} explores: it draws its actions, {100 * self.initial_std:.3g} % of the "
                "input range around the policy's at first, limits or not, and nothing confirms "
                "what it learns. That belongs into a simulator, with an ImprovementGuard among "
                "the callbacks. If this env is one: policy_kwargs={'simulator': True}.",
                stacklevel=4,
            )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        given = super()._get_constructor_parameters().items()
        own = {"initial_std": self.initial_std, "simulator": self.simulator}
        return {name: each for name, each in given if name not in NOT_OURS} | own
