"""Checks of what a policy is given: spaces, algorithm and keywords."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann.control import LinearMPC


def require_plain_td3(algorithm: BaseAlgorithm | None, other: dict[str, Any]) -> None:
    """Raise unless the algorithm is TD3 or DDPG on an env that does not normalise."""
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
            "problem, gamma, net_arch, activation_fn, actor_lr_mult, critic_lr_mult, critic, "
            "prediction_model, value_scale, critic_warmup, max_correction and pin_equilibrium."
        )


def require_box(name: str, space: spaces.Space[Any]) -> None:
    """Raise unless the space is a Box with one dimension."""
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


def require_matching(
    problem: LinearMPC, observation_space: spaces.Space[Any], action_space: spaces.Box
) -> None:
    """Raise unless the spaces are those of the law: theta in, inputs between its bounds out."""
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


def as_factor(name: str, value: float) -> float:
    """Return a factor, a finite float of at least 0."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise TypeError(f"{name} = {value!r} must be a number.")
    if not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name} = {value!r} must be a finite number of at least 0.")
    return float(value)


def require_critic_options(
    critic: str, prediction_model: object, value_scale: float, critic_warmup: int
) -> None:
    """Raise unless these are options of a critic."""
    if critic not in ("afterstate", "state_action"):
        raise ValueError(f"critic = {critic!r} must be 'afterstate' or 'state_action'.")
    if prediction_model is not None and not callable(prediction_model):
        raise TypeError(
            f"prediction_model = {prediction_model!r} must be a function of tensors (theta, u) "
            "that returns the next theta, or None for the linear model."
        )
    if prediction_model is not None and critic == "state_action":
        raise ValueError(
            "prediction_model is for critic='afterstate'; critic='state_action' predicts nothing."
        )
    if as_factor("value_scale", value_scale) == 0:
        raise ValueError("value_scale = 0 would leave the network without effect; give e.g. 30.")
    whole = isinstance(critic_warmup, (int, np.integer)) and not isinstance(critic_warmup, bool)
    if not whole or critic_warmup < 0:
        raise ValueError(
            f"critic_warmup = {critic_warmup!r} must be a whole number of updates, 0 for none."
        )


def as_max_correction(value: float | None) -> float | None:
    """Return the bound on the distance from the MPC, a fraction of the input range."""
    if value is None:
        return None
    if as_factor("max_correction", value) > 1:
        raise ValueError(
            f"max_correction = {value!r} is a fraction of the input range, 0 to 1, or None."
        )
    return float(value)


def as_net_arch(value: dict[str, list[int]] | list[int] | None) -> dict[str, list[int]]:
    """Return the hidden widths of actor (pi) and critic (qf), with defaults for what is missing."""
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
