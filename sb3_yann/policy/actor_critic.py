"""The YANN actor and critic, in the places of those of Stable-Baselines3's TD3 and DDPG.

Actions are in [-1, 1]. Stable-Baselines3 gives them units, in its `unscale_action`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_yann import networks
from sb3_yann._validation import (
    Array,
    NonFiniteWarning,
    check_choice,
    check_number,
    check_options,
    check_positive,
    check_type,
    warn,
)
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.mpc.problem import Value
from sb3_yann.control.online import Law
from sb3_yann.networks import AfterstateValue, SharedYannLayer, YannLayer
from sb3_yann.networks.value import PredictionModel
from sb3_yann.networks.yann import LawLayer, clamp_theta
from sb3_yann.policy.checks import require_own_problem
from sb3_yann.policy.observations import SeesTheta, keeps_entries, without_entries
from sb3_yann.policy.sb3_hooks import KeepsPrecision, what_is_not_finite

NETWORKS = ("per_region", "shared")
CRITICS = ("afterstate", "state_action")


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
        check_choice("kind", self.kind, CRITICS)
        wanted = "a function of tensors (theta, u) that returns the next theta, or None for the "
        wanted += "linear model"
        check_type("prediction_model", self.prediction_model, Callable | None, wanted)
        if self.prediction_model is not None and self.kind == "state_action":
            raise ValueError("prediction_model is for kind='afterstate', not for 'state_action'.")
        if self.value_scale is not None:
            hint = "It multiplies the network, or is None."
            check_positive("value_scale", self.value_scale, hint)
        check_positive("reward_scale", self.reward_scale, "Give 1 for the cost as it is.")
        check_number("reward_offset", self.reward_offset)

    @property
    def scales_itself(self) -> bool:
        """Whether the scale of the values comes from what is learnt from."""
        return self.value_scale is None and self.kind == "afterstate"


def as_critic_options(critic: str | CriticOptions | Mapping[str, Any]) -> CriticOptions:
    """Return the options of a critic from its kind, a mapping of some of them, or themselves."""
    if isinstance(critic, CriticOptions | Mapping):
        return check_options("critic", critic, CriticOptions)
    return CriticOptions(check_choice("critic", critic, CRITICS))


class YannActor(KeepsPrecision, SeesTheta, Actor):
    """SB3's actor with a law and its networks in place of the multi-layer perceptron.

    Parameters
    ----------
    problem : LinearMPC
        The MPC whose law the actor starts from.
    net_arch : list of int
        Widths of each network.
    activation_fn, max_correction, pin_equilibrium, law, networks, keep_bounds, bounds_margin
        As in :class:`YannPolicy`.
    **sb3_kwargs
        Other arguments of SB3's `Actor`: spaces and features extractor.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> actor = DDPG("YannPolicy", "CSTR-v0", device="cpu").actor
    >>> actor(th.zeros(1, 4)).shape
    torch.Size([1, 1])
    """

    mu: LawLayer  # type: ignore[assignment]

    def __init__(
        self,
        problem: LinearMPC,
        *,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.Tanh,
        max_correction: float | None = None,
        pin_equilibrium: bool = True,
        law: str = "auto",
        networks: str | None = None,
        keep_bounds: bool = False,
        bounds_margin: float = 0.0,
        **sb3_kwargs: Any,
    ) -> None:
        # No perceptron is built that would be thrown away.
        super().__init__(net_arch=[], activation_fn=activation_fn, **sb3_kwargs)
        self.net_arch = net_arch
        self.named = ""
        self.options = {
            "problem": problem,
            "max_correction": max_correction,
            "pin_equilibrium": pin_equilibrium,
            "law": law,
            "networks": networks,
            "keep_bounds": keep_bounds,
            "bounds_margin": bounds_margin,
        }
        rate = (problem.rate.du_min, problem.rate.du_max) if problem.has_rate_bounds else None
        given = problem.law(law)
        kind = layer_for(given, networks)
        own = tuple(net_arch), activation_fn(), max_correction, pin_equilibrium
        self.mu = kind(given, *own, rate, problem.kept_set if keep_bounds else None)
        if keep_bounds:
            self.mu.keep(bounds_margin)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """Return the actions in [-1, 1], (batch, m), finite whatever is observed and learnt."""
        modules: Any = self._modules  # an attribute of a module takes a microsecond to find
        theta = self.extract_features(obs, modules["features_extractor"])
        actions: th.Tensor = modules["mu"](theta)
        if th.jit.is_tracing() or th.compiler.is_compiling():  # type: ignore[attr-defined, no-untyped-call]
            return actions  # no branch that depends on numbers
        # NaN is all that an action can be beside a number in [-1, 1]. A few numbers are added
        # faster by Python than by torch, whose call takes as long as a small network.
        few = actions.numel() <= 16
        total = sum(map(sum, actions.tolist())) if few else actions.detach().sum().item()
        if math.isfinite(total):
            if self.named and not th.is_grad_enabled():  # the sensor is back, and no batch is it
                self.named = ""
            return actions
        lost = ~obs.flatten(1).isfinite()
        kept = obs.masked_fill(lost.view_as(obs), 0.0)
        theta = self.extract_features(kept, self.features_extractor)
        theta = without_entries(theta, lost, self.features_extractor)
        actions = self.mu(theta)
        whole = (~lost.any(1, keepdim=True)) & actions.detach().isfinite().all(1, keepdim=True)
        problem: LinearMPC = self.options["problem"]  # type: ignore[assignment]
        named = problem.model.state_names and keeps_entries(self.features_extractor)
        names = problem.labels() if named else ()
        message = what_is_not_finite(lost.cpu().numpy(), names)
        if message != self.named:  # once, for a sensor that stays so
            warn(message, NonFiniteWarning)
        self.named = message
        return th.where(whole, actions, self.mu.law(theta).to(actions))

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load parameters of an actor with the same law; ValueError for others, before any."""
        require_own_problem(self, state_dict, strict)
        return super().load_state_dict(state_dict, strict, assign)

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """Yield the weights, without the search of all modules for them at every step of SB3."""
        return iter(self.mu.network.weights()) if recurse else super().parameters(recurse)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self.options}


class YannCritic(KeepsPrecision, SeesTheta, ContinuousCritic):
    """SB3's critic with networks that start as the value of the law on the linear plant.

    Parameters
    ----------
    problem : LinearMPC
    gamma : float
        Discount of the return that the critic puts out.
    options : CriticOptions
    pin_equilibrium, activation_fn
        As in :class:`YannPolicy`.
    net_arch : list of int
        Widths of each critic's network.
    n_critics : int, default 2
    n_outputs : int, default 1
        Of each critic: quantiles of the return.
    **sb3_kwargs
        Other arguments of SB3's `ContinuousCritic`: spaces and features extractor.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> critic = DDPG("YannPolicy", "CSTR-v0", device="cpu").critic
    >>> critic.q1_forward(th.zeros(1, 4), th.zeros(1, 1)).shape
    torch.Size([1, 1])
    """

    clamped: th.Tensor | None

    def __init__(
        self,
        problem: LinearMPC,
        gamma: float,
        options: CriticOptions,
        pin_equilibrium: bool = True,
        *,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.Tanh,
        n_critics: int = 2,
        n_outputs: int = 1,
        **sb3_kwargs: Any,
    ) -> None:
        sb3_kwargs |= {"activation_fn": activation_fn, "n_critics": n_critics}
        super().__init__(net_arch=[], **sb3_kwargs)
        self.gamma = gamma
        self.scale = float(options.reward_scale)
        if options.reward_offset and not gamma < 1:
            raise ValueError(f"reward_offset = {options.reward_offset!r} needs a discount below 1.")
        self.offset = options.reward_offset and float(options.reward_offset) / (1 - gamma)
        self.scales_itself = options.scales_itself
        self.batch: th.Tensor | None = None  # the latest points to learn from
        common: dict[str, Any] = {
            "ranges": networks.Ranges(
                problem.theta_half, problem.deviations.u_min, problem.deviations.u_max
            ),
            "hidden": tuple(net_arch),
            "pinned": pin_equilibrium,
            "n_outputs": n_outputs,
        }
        ends = None if problem.clamped is None else th.as_tensor(np.array(problem.clamped))
        self.register_buffer("clamped", ends, persistent=False)
        self.q_networks = []
        for i in range(n_critics):
            common["activation"] = activation_fn()
            q_network = _initial_value(problem, gamma, options, common)
            self.add_module(f"qf{i}", q_network)
            self.q_networks.append(q_network)

    def extract_features(self, obs: Any, features_extractor: Any) -> th.Tensor:
        """Return theta as the law takes it: what is asked for within its range."""
        return clamp_theta(super().extract_features(obs, features_extractor), self.clamped)

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return Q of each critic, all (batch, 1), in units of the env's reward."""
        theta = self.extract_features(obs, self.features_extractor)  # never trained
        points = th.cat([theta, actions], dim=1)
        if th.is_grad_enabled():
            self.know_scale(points)
        return self.values(points)

    def know_scale(self, points: th.Tensor) -> None:
        """Take the factor of the networks, not known yet, from points ``[theta, action]``."""
        if self.scales_itself:
            self.batch = points.detach()
            first: Any = self.q_networks[0]
            if not first.value_scale > 0:
                self.scale_values()

    def scale_values(self) -> None:
        """Set the factor of networks that are zero to the batch's stage cost for good, if any."""
        networks: list[Any] = self.q_networks
        if (cost := self.stage_cost_of_batch()) > 0:
            for q_network in networks:
                q_network.value_scale.fill_(cost / self.share_of_a_step)

    def state_value(self, obs: th.Tensor) -> th.Tensor:
        """Return the first critic's value of states under the law, (batch, 1), in rewards."""
        first: Any = self.q_networks[0]
        theta = self.extract_features(obs, self.features_extractor)
        return self._in_rewards(-first.value(theta.double()).float())

    @property
    def share_of_a_step(self) -> float:
        """What one step is of the sum of equal stage costs, discounted for good."""
        return max(1 - self.gamma, 1 / 100)  # for good: a hundred samples at most

    def stage_cost_of_batch(self) -> float:
        """Return the mean stage cost of the latest points to learn from."""
        first: Any = self.q_networks[0]
        return 0.0 if self.batch is None else float(first.mean_stage_cost(self.batch))

    def rescale(self, stage_cost: float, optimizer: th.optim.Optimizer | None = None) -> float:
        """Double or halve the factor where that cost for good is beyond; return the factor.

        What the networks put out stays as it is, and their last layer's moments stay true.
        """
        networks: list[Any] = self.q_networks
        scale: float = networks[0].scale
        wanted = stage_cost / self.share_of_a_step
        factor = 2.0 ** (round(math.log2(wanted / scale)) if wanted > 0 else 0)
        for q_network in networks if factor != 1 else []:
            q_network.value_scale.mul_(factor)
            last = q_network.network.weights()[-1]
            last.data.div_(factor)
            moments = {} if optimizer is None else optimizer.state.get(last, {})
            for power, name in enumerate(("exp_avg", "exp_avg_sq"), start=1):
                if name in moments:
                    moments[name].mul_(factor**power)
        return scale * factor

    def values(self, points: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return Q of each critic, all (batch, 1), at points ``[theta, action]``."""
        return tuple(self._in_rewards(q_network(points)) for q_network in self.q_networks)

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """Yield the weights, without the search of all modules for them."""
        if not recurse:
            return super().parameters(recurse)
        networks: list[Any] = self.q_networks
        return (each for q_network in networks for each in q_network.weights())

    def _in_rewards(self, q: th.Tensor) -> th.Tensor:
        return q if (self.scale, self.offset) == (1, 0) else self.scale * q + self.offset

    def q1_forward(self, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return the first critic's Q, (batch, 1), with a gradient by the actions alone."""
        first: Any = self.q_networks[0]
        trained = [each for each in first.weights() if each.requires_grad]
        try:
            for parameter in trained:
                parameter.requires_grad_(False)
            return self._in_rewards(super().q1_forward(obs, actions))
        finally:
            for parameter in trained:
                parameter.requires_grad_(True)


def layer_for(law: Law, networks: str | None) -> Any:
    """Return the class of layers around a law; ValueError for regions that it does not have."""
    if networks is not None:
        check_choice("networks", networks, NETWORKS)
    if isinstance(law, PiecewiseAffine):
        return SharedYannLayer if networks == "shared" else YannLayer
    if networks == "per_region":
        raise ValueError(
            "networks = 'per_region' needs the regions of an explicit law, and this law is solved "
            "online. Take networks='shared', or solve problem.explicit() before, without a limit."
        )
    return SharedYannLayer


def _initial_value(
    problem: LinearMPC, gamma: float, options: CriticOptions, common: dict[str, Any]
) -> nn.Module:
    n = problem.n_theta

    def form_of(terms: Value) -> Array:
        """Return the form of ``[theta; u]``, with prices that of ``[theta; 1; u]``."""
        if not problem.price.counts:
            return terms.P
        last = len(terms.P)
        order = [*range(n), last, *range(n, last)]
        return terms.form[np.ix_(order, order)]

    if options.kind == "state_action":
        M = form_of(problem.state_action_terms(gamma))
        return networks.QuadraticStateActionValue(M, **common)
    model = options.prediction_model
    if model is None:
        model = networks.LinearPrediction(*problem.prediction)
    stage = Value(problem.stage_matrix, problem.stage_slope, problem.deviations.price.constant)
    W = form_of(stage)
    P = form_of(problem.value_terms(gamma))
    return AfterstateValue(W, P, model, gamma, scale=options.value_scale, **common)
