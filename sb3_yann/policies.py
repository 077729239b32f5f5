"""The YANN actor, critic and policy for Stable-Baselines3's TD3 and DDPG."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_yann.control import LinearMPC
from sb3_yann.networks import QuadraticStateActionValue, YannLayer
from sb3_yann.problems import resolve_problem


class YannActor(Actor):
    """SB3's actor with a :class:`YannLayer` in place of the multi-layer perceptron.

    Parameters are those of SB3's `Actor`, and ``problem``, the MPC whose explicit law it starts
    from. ``net_arch`` is the width of each region's network.
    """

    mu: YannLayer  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: nn.Module,
        features_dim: int,
        problem: LinearMPC,
        activation_fn: type[nn.Module] = nn.Tanh,
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            [],  # no perceptron is built that would be thrown away
            features_extractor,
            features_dim,
            activation_fn,
            normalize_images,
        )
        self.net_arch = net_arch
        self.problem = problem
        self.mu = YannLayer(problem.explicit(), tuple(net_arch), activation_fn())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "problem": self.problem}


class YannCritic(ContinuousCritic):
    """SB3's critic with :class:`QuadraticStateActionValue` networks, one for each critic.

    Parameters are those of SB3's `ContinuousCritic`; ``problem``, the MPC; and ``gamma``, the
    discount of the return that it puts out.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        problem: LinearMPC,
        gamma: float,
        activation_fn: type[nn.Module] = nn.Tanh,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            [],
            features_extractor,
            features_dim,
            activation_fn,
            normalize_images,
            n_critics,
            share_features_extractor,
        )
        M = problem.state_action_matrix(gamma)
        self.q_networks = []
        for i in range(n_critics):
            q_network = QuadraticStateActionValue(
                M,
                (problem.theta_max - problem.theta_min) / 2,
                problem.u_min,
                problem.u_max,
                tuple(net_arch),
                activation_fn(),
            )
            self.add_module(f"qf{i}", q_network)
            self.q_networks.append(q_network)


class YannPolicy(TD3Policy):
    """A TD3 or DDPG policy that starts as a linear MPC, exactly, with the critic that goes with it.

    The actor's output is the explicit law of the MPC plus networks that are zero at first; the
    critic is the state-action value of the law on the linear model, plus such a network.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box, shape (n,)
        The parameter theta of the law.
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
    n_critics : int, default 2
        TD3's two critics; DDPG sets 1.
    features_extractor_class, features_extractor_kwargs, normalize_images, share_features_extractor
        As SB3 passes them; only its defaults are taken, since theta must reach the law as it is.
    optimizer_class, optimizer_kwargs
        As in SB3's `TD3Policy`.

    Raises
    ------
    TypeError
        If a space is not a Box, or the algorithm is not TD3 or DDPG. (DDPG and TD3 themselves
        refuse actions that are no Box, or have no bounds, with an AssertionError of their own.)
    ValueError
        If there is no problem, the spaces do not fit it, or the env normalises.
    """

    actor: YannActor
    actor_target: YannActor
    critic: YannCritic
    critic_target: YannCritic

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
        n_critics: int = 2,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        share_features_extractor: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **other: Any,
    ) -> None:
        algorithm = _algorithm_under_construction()
        _require_plain_td3(algorithm, other)
        if features_extractor_class is not FlattenExtractor:
            raise ValueError(
                f"features_extractor_class = {features_extractor_class.__name__} would change the "
                "parameter of the law; leave it at FlattenExtractor."
            )
        _require_box("observation_space", observation_space)
        _require_box("action_space", action_space)
        self.problem = resolve_problem(problem, observation_space)
        if algorithm is not None and isinstance(problem, str):
            # Saved by value with the model: a load then neither looks it up nor solves it again.
            algorithm.policy_kwargs = {**algorithm.policy_kwargs, "problem": self.problem}
        _require_matching(self.problem, observation_space, action_space)
        self.gamma = getattr(algorithm, "gamma", 0.99) if gamma is None else gamma
        if isinstance(n_critics, bool) or not isinstance(n_critics, int) or n_critics < 1:
            raise ValueError(f"n_critics = {n_critics!r} must be a whole number of at least 1.")
        if not (isinstance(activation_fn, type) and issubclass(activation_fn, nn.Module)):
            raise TypeError(
                f"activation_fn = {activation_fn!r} must be a class such as torch.nn.Tanh."
            )
        self.lr_mult = {
            "actor": _as_multiplier("actor_lr_mult", actor_lr_mult),
            "critic": _as_multiplier("critic_lr_mult", critic_lr_mult),
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=_as_net_arch(net_arch),
            activation_fn=activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
            share_features_extractor=share_features_extractor,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self._multiply_learning_rates()

    def _multiply_learning_rates(self) -> None:
        for network, factor in ((self.actor, "actor"), (self.critic, "critic")):
            _multiply_learning_rate(network.optimizer, self.lr_mult[factor])

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or a pickle; torch drops the hooks of optimizers on the way."""
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._multiply_learning_rates()

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannActor:
        """Return an actor that equals the explicit law, with networks that are zero."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return YannActor(**kwargs, problem=self.problem).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannCritic:
        """Return a critic that is the law's value on the linear model, with networks of zero."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return YannCritic(**kwargs, problem=self.problem, gamma=self.gamma).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        return {
            **data,
            "problem": self.problem,
            "gamma": self.gamma,
            "actor_lr_mult": self.lr_mult["actor"],
            "critic_lr_mult": self.lr_mult["critic"],
        }


# DDPG shares this table, so DDPG("YannPolicy", env) works as well.
TD3.policy_aliases["YannPolicy"] = YannPolicy


def _algorithm_under_construction() -> BaseAlgorithm | None:
    """Return the algorithm whose `_setup_model` is building a policy, None where nobody is.

    SB3 hands a policy its spaces and its learning rate, but not the discount, which the critic
    needs to be exact; so the caller's frame is asked. Called from a policy's `__init__` only.
    """
    frame = sys._getframe(1)
    while frame.f_code.co_name == "__init__" and frame.f_back is not None:
        frame = frame.f_back
    caller = frame.f_locals.get("self")
    return caller if isinstance(caller, BaseAlgorithm) else None


def _require_plain_td3(algorithm: BaseAlgorithm | None, other: dict[str, Any]) -> None:
    if algorithm is not None and not isinstance(algorithm, TD3):
        raise TypeError(
            f"YannPolicy starts from a deterministic law and works with DDPG and TD3, not with "
            f"{type(algorithm).__name__}. Use e.g. DDPG(YannPolicy, env)."
        )
    normalize = None if algorithm is None else algorithm.get_vec_normalize_env()
    if normalize is not None and (normalize.norm_obs or normalize.norm_reward):
        raise ValueError(
            "The env is a VecNormalize: normalised observations are not the state that the law "
            "takes, normalised rewards not the cost that the critic stands for. Train without it."
        )
    if other:
        raise TypeError(
            f"YannPolicy takes no {', '.join(map(repr, other))}. Its own policy_kwargs are "
            "problem, gamma, net_arch, activation_fn, actor_lr_mult and critic_lr_mult."
        )


def _require_box(name: str, space: spaces.Space[Any]) -> None:
    if not isinstance(space, spaces.Box):
        raise TypeError(
            f"{name} is a {type(space).__name__}, YannPolicy needs a Box. "
            "Wrap the env so that observations and actions are vectors of real numbers."
        )
    if len(space.shape) != 1:
        raise ValueError(
            f"{name} has shape {space.shape}, YannPolicy needs one dimension, (n,). "
            "Wrap the env in gymnasium.wrappers.FlattenObservation, or observe the plant's state."
        )


def _require_matching(
    problem: LinearMPC, observation_space: spaces.Space[Any], action_space: spaces.Box
) -> None:
    if observation_space.shape != (problem.n_theta,):
        raise ValueError(
            f"The observation has shape {observation_space.shape}, but the law of the problem "
            f"takes theta of shape ({problem.n_theta},). Give the policy the problem of this plant."
        )
    if not np.issubdtype(action_space.dtype, np.floating):
        raise TypeError(
            f"action_space has dtype {action_space.dtype}, but the inputs of an MPC are real: make "
            "it a Box of numpy.float32."
        )
    if not action_space.is_bounded():
        raise ValueError(f"action_space = {action_space} must have finite bounds.")
    law = (problem.u_min, problem.u_max)
    env = (action_space.low, action_space.high)
    reach = np.where(np.isfinite(law[1] - law[0]), law[1] - law[0], 1.0)
    if env[0].shape != law[0].shape or any(
        np.any(np.abs(ours - theirs) > 1e-6 * reach) for ours, theirs in zip(law, env, strict=True)
    ):
        raise ValueError(
            f"The action space is [{env[0].tolist()}, {env[1].tolist()}], but the MPC has u_min = "
            f"{law[0].tolist()} and u_max = {law[1].tolist()}. They must be the same: build the "
            "LinearMPC with the bounds of the env, and leave out wrappers that rescale actions."
        )


def _as_multiplier(name: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise TypeError(f"{name} = {value!r} must be a number: 0 freezes, 1 is SB3's own rate.")
    if not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} = {value!r} must be a finite number, 0 (frozen) or above.")
    return float(value)


def _as_net_arch(value: dict[str, list[int]] | list[int] | None) -> dict[str, list[int]]:
    known = {"pi": [16, 16], "qf": [64, 64]}
    if value is None:
        return known
    if isinstance(value, list):  # SB3's short form
        value = dict.fromkeys(known, value)
    if not isinstance(value, dict) or not set(value) <= set(known):
        raise ValueError(f"net_arch = {value!r} must be a dict such as {known}.")
    for name, widths in value.items():
        sizes = list(widths) if isinstance(widths, (list, tuple)) else []
        if len(sizes) not in (1, 2) or not all(isinstance(n, int) and n > 0 for n in sizes):
            raise ValueError(
                f"net_arch[{name!r}] = {widths!r} must name the widths of one or two hidden "
                f"layers, such as {known[name]}."
            )
    return {**known, **value}


def _multiply_learning_rate(optimizer: th.optim.Optimizer, factor: float) -> None:
    """Make each step of the optimizer use ``factor`` times the rate that SB3 keeps setting."""
    optimizer.register_step_pre_hook(partial(_apply_multiplier, factor))
    optimizer.register_step_post_hook(_remove_multiplier)


def _apply_multiplier(factor: float, optimizer: th.optim.Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["scheduled_lr"] = group["lr"]
        group["lr"] = factor * group["lr"]


def _remove_multiplier(optimizer: th.optim.Optimizer, *_: Any) -> None:
    for group in optimizer.param_groups:
        group["lr"] = group.pop("scheduled_lr")
