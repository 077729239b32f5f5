"""The YANN policy for Stable-Baselines3's TD3 and DDPG."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_yann.control import LinearMPC
from sb3_yann.networks import RowAdam
from sb3_yann.networks.value import PredictionModel
from sb3_yann.networks.zero_output import FEW
from sb3_yann.policy._checks import (
    as_factor,
    as_max_correction,
    as_net_arch,
    as_reward,
    require_box,
    require_critic_options,
    require_matching,
    require_plain_td3,
    require_undone_normalization,
    warn_of_absolute_inputs,
)
from sb3_yann.policy._features import AffineFeatures
from sb3_yann.policy._finite import finite_gradient, warn_of_refused_step, watch_buffer
from sb3_yann.policy._sb3_hooks import (
    algorithm_under_construction,
    multiply_learning_rate,
    restore_learning_rate,
)
from sb3_yann.policy.actor_critic import YannActor, YannCritic
from sb3_yann.policy.observations import AffineObservation
from sb3_yann.policy.problem_registry import resolve_problem

__all__ = ["YannActor", "YannCritic", "YannPolicy"]


class YannPolicy(TD3Policy):
    """A TD3 or DDPG policy that starts as a linear MPC, exactly, with the critic that goes with it.

    The actor's output is the explicit law of the MPC plus networks that are zero at first; the
    critic is the state-action value of the law on the linear model, plus such a network.

    Nothing is learnt from what is not finite. The replay buffer leaves such transitions out, and a
    step is not taken whose gradient overflows float32, so that training cannot make actor or critic
    NaN. Where an observation or the actor's networks are not finite, the law acts. Each is named by
    a :class:`NonFiniteWarning`.

    TD3 adds noise to the target policy by default, which teaches the critic the value of a noisy
    controller: pass ``target_policy_noise=0.0`` to TD3, so that the exact critic stays the target.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box
        The parameter theta of the law, shape (n_theta,), or what ``observation`` makes theta of:
        the state and, where the problem has them, the reference, the disturbance and the previous
        input (see :mod:`sb3_yann.wrappers`).
    action_space : gymnasium.spaces.Box, shape (m,)
        Its bounds must be ``u_min`` and ``u_max`` of the problem.
    lr_schedule : callable
        SB3's learning rate schedule.
    problem : LinearMPC or str, optional
        The MPC, the name of a registered one, or ``"module:attribute"``. The default is the
        ``problem`` that the observation space carries, as those of our environments do.
    gamma : float, optional
        Discount of the critic. The default is that of the algorithm that builds the policy, or
        0.99 where the policy is built by hand.
    net_arch : dict or list, optional
        Widths of the trainable networks, ``{"pi": [16, 16], "qf": [64, 64]}`` by default: one
        or two hidden layers for each region of the actor, and for each critic.
    activation_fn : type, default torch.nn.Tanh
        An activation that is 0 at 0.
    actor_lr_mult, critic_lr_mult : float, default 0.1 and 1
        Learning rates of actor and critic, as multiples of the algorithm's ``learning_rate``, which
        is what SB3 logs; 0 freezes.
    critic : {"afterstate", "state_action"}, default "afterstate"
        What the critic learns: the value of the predicted next state (:class:`AfterstateValue`), or
        the paper's function of state and action (:class:`QuadraticStateActionValue`).
    prediction_model : callable, optional
        ``(theta, u) -> next theta`` for the afterstate critic, differentiable, of float64 tensors
        (batch, n) and (batch, m) in physical units. The default is the MPC's ``A theta + B u``.
    value_scale : float, default 30
        Factor of the afterstate critic's network, in units of the cost-to-go: of the order of the
        changes of V that there are to learn.
    critic_warmup : int, default 2000
        Updates of the critic before the first one of the actor, which is the MPC until then.
    max_correction : float, optional
        Bound on the distance from the MPC, as a fraction of the input range, 0 to 1: exact,
        whatever is learnt. The default is none.
    pin_equilibrium : bool, optional
        Whether actor and critic keep their value at ``theta = 0`` for good. The default is
        False for problems with references or disturbances, and True for others: with those,
        ``theta = 0`` is one of many steady states, and a correction pinned to zero there could not
        remove the offset that a wrong steady-state input leaves. Leave it free too where the
        steady-state input of a regulator's model is not the plant's.
    observation : AffineObservation, optional
        The map from an observation to theta. The default is the identity.
    reward_scale, reward_offset : float, default 1 and 0
        The env's reward is ``reward_scale * (-c) + reward_offset``, where c is the stage cost of
        the problem: the critic starts as ``reward_scale * Q + reward_offset / (1 - gamma)``, exact
        for episodes that end by a time limit only. :class:`CostAudit` finds these numbers.
    n_critics : int, default 2
        TD3's two critics; DDPG sets 1.
    features_extractor_class, features_extractor_kwargs, normalize_images, share_features_extractor
        As SB3 passes them; only its defaults are taken, since theta must reach the law as it is.
    optimizer_class, optimizer_kwargs
        As in SB3's `TD3Policy`. In place of Adam the actor of more than 32 regions has
        :class:`RowAdam`, which steps the networks of the regions in use alone; its gradients are
        sparse then, until ``actor.mu.row_gradients`` is set to False. Other optimizers, and
        arguments other than ``eps`` and ``betas``, get dense ones.

    Raises
    ------
    TypeError
        If a space is not a Box, or the algorithm is not TD3 or DDPG. (DDPG and TD3 themselves
        refuse actions that are no Box, or have no bounds, with an AssertionError of their own.)
    ValueError
        If there is no problem, the spaces do not fit it, or the env normalizes.
    """

    actor: YannActor
    actor_target: YannActor
    critic: YannCritic
    critic_target: YannCritic
    critic_updates: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        problem: LinearMPC | str | None = None,
        gamma: float | None = None,
        net_arch: dict[str, list[int]] | list[int] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        actor_lr_mult: float = 0.1,
        critic_lr_mult: float = 1.0,
        critic: str = "afterstate",
        prediction_model: PredictionModel | None = None,
        value_scale: float = 30.0,
        critic_warmup: int = 2000,
        max_correction: float | None = None,
        pin_equilibrium: bool | None = None,
        observation: AffineObservation | None = None,
        reward_scale: float = 1.0,
        reward_offset: float = 0.0,
        n_critics: int = 2,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        share_features_extractor: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **other: Any,
    ) -> None:
        algorithm = algorithm_under_construction()
        require_plain_td3(algorithm, other)
        if features_extractor_class is not FlattenExtractor:
            raise ValueError(
                f"features_extractor_class = {features_extractor_class.__name__} would change the "
                "parameter of the law; leave it at FlattenExtractor."
            )
        require_box("observation_space", observation_space, flattened=observation is not None)
        require_box("action_space", action_space)
        self.problem = resolve_problem(problem, observation_space)
        if algorithm is not None and isinstance(problem, str):
            # Saved by value with the model: a load then neither looks it up nor solves it again.
            algorithm.policy_kwargs = {**algorithm.policy_kwargs, "problem": self.problem}
        require_matching(self.problem, observation_space, action_space, observation)
        warn_of_absolute_inputs(self.problem, algorithm)
        require_undone_normalization(self.problem, algorithm, observation)
        self.observation = observation
        self.gamma = getattr(algorithm, "gamma", 0.99) if gamma is None else gamma
        self.reward_scale, self.reward_offset = as_reward(reward_scale, reward_offset, self.gamma)
        if isinstance(n_critics, bool) or not isinstance(n_critics, int) or n_critics < 1:
            raise ValueError(f"n_critics = {n_critics!r} must be a whole number of at least 1.")
        if not (isinstance(activation_fn, type) and issubclass(activation_fn, nn.Module)):
            raise TypeError(
                f"activation_fn = {activation_fn!r} must be a class such as torch.nn.Tanh."
            )
        self.lr_mult = {
            "actor": as_factor("actor_lr_mult", actor_lr_mult),
            "critic": as_factor("critic_lr_mult", critic_lr_mult),
        }
        require_critic_options(critic, prediction_model, value_scale, critic_warmup)
        if pin_equilibrium is None:
            pin_equilibrium = not self.problem.layout.has_constants
        if not isinstance(pin_equilibrium, bool):
            raise TypeError(f"pin_equilibrium = {pin_equilibrium!r} must be True or False.")
        if optimizer_class is th.optim.Adam and optimizer_kwargs is None:
            optimizer_kwargs = {"fused": True}  # the same steps, in a third of the time
        self.actor_step = 1.0
        """Another factor of the actor's learning rate, which an ImprovementGuard sets."""
        self.refused = {"actor": 0, "critic": 0}
        """Steps that were not taken, since their gradient was not finite."""
        self.batch_is_finite = True
        self.critic_warmup = critic_warmup
        self.actor_options: dict[str, Any] = {
            "max_correction": as_max_correction(max_correction),
            "pin_equilibrium": pin_equilibrium,
        }
        self.critic_options: dict[str, Any] = {
            "kind": critic,
            "prediction_model": prediction_model,
            "value_scale": value_scale,
            "pin_equilibrium": pin_equilibrium,
            "reward_scale": self.reward_scale,
            "reward_offset": self.reward_offset,
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=as_net_arch(net_arch),
            activation_fn=activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
            share_features_extractor=share_features_extractor,
        )
        if algorithm is not None:
            watch_buffer(algorithm)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        chosen = {name: each for name, each in self.optimizer_kwargs.items() if name != "fused"}
        adam = self.optimizer_class is th.optim.Adam and chosen.keys() <= {"betas", "eps"}
        if adam and self.problem.explicit().n_regions > FEW:
            # A step, and its gradients, of the regions in use alone.
            self.actor.optimizer = RowAdam(self.actor.parameters(), lr=lr_schedule(1), **chosen)
            self.actor.mu.row_gradients = True
        # A buffer travels with the parameters: a model that is loaded goes on where it was.
        self.register_buffer("critic_updates", th.zeros((), dtype=th.int64))
        self._attach_hooks()

    def _attach_hooks(self) -> None:
        for optimizer, before in (
            (self.actor.optimizer, self._before_actor_step),
            (self.critic.optimizer, self._before_critic_step),
        ):
            optimizer.register_step_pre_hook(before)
            optimizer.register_step_post_hook(restore_learning_rate)

    def _refuses(self, name: str, optimizer: th.optim.Optimizer) -> bool:
        """Return whether a step must not be taken, for which it has no gradient any more then."""
        if finite_gradient(optimizer):
            return False
        self.refused[name] += 1
        warn_of_refused_step(name, optimizer, self.refused[name])
        optimizer.zero_grad()
        return True

    def _before_actor_step(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        # What the critic refuses to learn from says nothing to the actor either.
        if self.critic_updates < self.critic_warmup or not self.batch_is_finite:
            optimizer.zero_grad()  # no gradient at all: neither parameters nor moments move
        else:
            self._refuses("actor", optimizer)
        multiply_learning_rate(optimizer, self.lr_mult["actor"] * self.actor_step)

    def _before_critic_step(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        self.batch_is_finite = not self._refuses("critic", optimizer)
        if self.batch_is_finite:
            self.critic_updates.add_(1)
        multiply_learning_rate(optimizer, self.lr_mult["critic"])

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or a pickle; torch drops the hooks of optimizers on the way."""
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._attach_hooks()

    def theta(self, observations: ArrayLike) -> th.Tensor:
        """Return the parameter of the law, (batch, n_theta), for observations (batch, ...)."""
        obs = th.as_tensor(np.asarray(observations), device=self.device)
        with th.no_grad():
            return self.actor.extract_features(obs, self.actor.features_extractor)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Return the map from an observation to theta."""
        if self.observation is None:
            return super().make_features_extractor()
        return AffineFeatures(self.observation_space, self.observation)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannActor:
        """Return an actor that equals the explicit law, with networks that are zero."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return YannActor(**kwargs, problem=self.problem, **self.actor_options).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannCritic:
        """Return a critic that is the law's value on the linear model, with networks of zero."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        critic = YannCritic(**kwargs, problem=self.problem, gamma=self.gamma, **self.critic_options)
        return critic.to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        return {
            **data,
            "problem": self.problem,
            "gamma": self.gamma,
            "actor_lr_mult": self.lr_mult["actor"],
            "critic_lr_mult": self.lr_mult["critic"],
            "critic": self.critic_options["kind"],
            "prediction_model": self.critic_options["prediction_model"],
            "value_scale": self.critic_options["value_scale"],
            "critic_warmup": self.critic_warmup,
            "observation": self.observation,
            "reward_scale": self.reward_scale,
            "reward_offset": self.reward_offset,
            **self.actor_options,
        }


# DDPG shares this table, so DDPG("YannPolicy", env) works as well.
TD3.policy_aliases["YannPolicy"] = YannPolicy
