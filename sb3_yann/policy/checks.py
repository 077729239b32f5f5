"""Checks of what a policy is given: problem, spaces, algorithm, keywords and parameters."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_yann._validation import check_int, warn
from sb3_yann.control import LinearMPC
from sb3_yann.control.wrapper_stack import SHOW_THETA
from sb3_yann.networks import AfterstateValue, QuadraticStateActionValue, SharedYannLayer
from sb3_yann.networks.yann import LawLayer
from sb3_yann.policy.observations import (
    IN_YAML,
    AffineFeatures,
    AffineObservation,
    require_frozen,
    require_outermost,
    statistics_of,
)
from sb3_yann.units import ActionUnits
from sb3_yann_envs.spaces import resolve_reference

_registered: dict[str, LinearMPC | Callable[[], LinearMPC] | str] = {
    "CSTR-v0": "sb3_yann_envs.problems:cstr",
    "ClippedPendulum-v0": "sb3_yann_envs.problems:clipped_pendulum",
}
LOST_STATISTICS = (
    "The model takes observations as a VecNormalize shows them, and its env has none: Stable-"
    "Baselines3 saves its statistics apart. Keep them with venv.save(path), and load the model "
    "with env=VecNormalize.load(path, venv)."
)


def register_problem(name: str, problem: LinearMPC | Callable[[], LinearMPC] | str) -> None:
    """Make ``problem`` known as ``name``, for YAML files and ``policy_kwargs``.

    Parameters
    ----------
    name : str
        Without a colon. Registering a name again replaces its problem.
    problem : LinearMPC, callable or str
        The problem, a function without arguments that returns it, or ``"module:attribute"``.

    Examples
    --------
    >>> register_problem("my-reactor", "sb3_yann_envs.problems:cstr")
    >>> resolve_problem("my-reactor", None).model.n_states
    4
    """
    if not isinstance(name, str) or not name or ":" in name:
        raise ValueError(f"name = {name!r} must be a non-empty string without ':'.")
    if not (isinstance(problem, LinearMPC | str) or inspect.isroutine(problem)):
        wanted = 'a LinearMPC, a function that returns one, or "module:attribute"'
        raise TypeError(f"problem = {problem!r} must be {wanted}.")
    _registered[name] = problem


def resolve_problem(problem: LinearMPC | str | None, observation_space: Any) -> LinearMPC:
    """Return the LinearMPC that is meant: given, named, or carried by the observation space."""
    if problem is None:
        problem = getattr(observation_space, "problem", None)
    if problem is None:
        raise ValueError(
            f"YannPolicy has no problem: the observation space {observation_space} carries none. "
            'Pass policy_kwargs={"problem": mpc} with a LinearMPC, a registered name '
            f'({", ".join(sorted(_registered))}) or "module:attribute".'
        )
    found: Any = problem
    if isinstance(found, str) and ":" not in found:
        if found not in _registered:
            raise ValueError(
                f"No problem is registered as {found!r}; there are {sorted(_registered)}. Call "
                'sb3_yann.register_problem, or refer to it as "module:attribute".'
            )
        found = _registered[found]
    if isinstance(found, str):
        found = resolve_reference(found)
    if inspect.isroutine(found):
        found = found()
    if not isinstance(found, LinearMPC):
        raise TypeError(f"problem = {problem!r} is {found!r}, expected a LinearMPC.")
    return found


def require_algorithm(algorithm: BaseAlgorithm | None, kinds: tuple[type, ...]) -> None:
    """Raise unless an algorithm is one of those that train a policy."""
    if algorithm is not None and not isinstance(algorithm, kinds):
        name = type(algorithm).__name__
        what = " and ".join(each.__name__ for each in kinds)
        names = "DDPG", "TD3", "SAC", "TQC", "PPO"
        raise TypeError(
            f"This policy is one of {what}, not of {name}. {', '.join(names)} each have one, found "
            f'by its name: {name if name in names else "PPO"}("YannPolicy", env).'
        )


def as_gamma(gamma: float | None, algorithm: BaseAlgorithm | None) -> float:
    """Return the discount that is given, else the algorithm's."""
    if gamma is not None:
        return gamma
    if algorithm is not None:
        return float(algorithm.gamma)  # type: ignore[attr-defined]
    raise ValueError(
        "YannPolicy does not find the DDPG or TD3 that builds it, and so neither its discount nor "
        "a VecNormalize. Let the algorithm build it, in the same thread: DDPG(YannPolicy, env). "
        "For a policy that stands alone, or else, pass the discount: policy_kwargs={'gamma': ...}; "
        "its observations must then not be normalized."
    )


def require_gamma(algorithm: Any, gamma: float) -> None:
    """Raise ValueError for a discount that is not the one which the critic was built for."""
    if (now := algorithm.gamma) == gamma:
        return
    name = type(algorithm).__name__
    raise ValueError(
        f"gamma of the {name} was set to {now} after its policy was built for {gamma}: the critic "
        f"is exact for that one alone. Build the {name} with gamma={now}, or go on from the old "
        f"critic: load the model with custom_objects={{'gamma': {now}}}."
    )


def warn_of_another_gamma(algorithm: BaseAlgorithm, gamma: float) -> None:
    """Warn where a model is loaded with another discount than it was saved with."""
    saved = vars(algorithm).get("critic_gamma", gamma)
    vars(algorithm)["critic_gamma"] = gamma
    if saved != gamma:
        warn(
            f"gamma = {gamma:g}, but the critic of this file is the value for {saved:g}: learning "
            "goes on from it, and it is wrong at first. A new model with the problem and this "
            "gamma has the exact one."
        )


def require_sb3_kwargs(given: dict[str, Any], own: list[str], theirs: tuple[str, ...]) -> None:
    """Raise unless all keywords but the policy's ``own`` are SB3's, or of its policy ``theirs``."""
    known = "features_extractor_class features_extractor_kwargs normalize_images".split()
    known += ["share_features_extractor", "optimizer_class", "optimizer_kwargs", *theirs]
    if unknown := [name for name in given if name not in known]:
        raise TypeError(
            f"YannPolicy takes no {', '.join(map(repr, unknown))}. Its own policy_kwargs are "
            f"{', '.join(own)}; of SB3's it takes {', '.join(known)}. Options of the critic "
            "go into policy_kwargs={'critic': CriticOptions(...)}."
            + " SB3's SAC and PPO write it into the dict: pass each model its own."
            * ("use_sde" in unknown)
        )
    if given.get("features_extractor_class", FlattenExtractor) is not FlattenExtractor:
        raise ValueError(
            "features_extractor_class must stay FlattenExtractor: the law takes theta."
        )
    check_int("n_critics", given.get("n_critics", 1))


def with_fused_adam(given: dict[str, Any]) -> dict[str, Any]:
    """Return SB3's keywords, with an Adam that takes the same steps in a third of the time."""
    adam = given.get("optimizer_class", th.optim.Adam) is th.optim.Adam
    if adam and given.get("optimizer_kwargs") is None:
        return {**given, "optimizer_kwargs": {"fused": True}}
    return given


def as_activation(value: Any) -> type[nn.Module]:
    """Return a class of activations."""
    if not (isinstance(value, type) and issubclass(value, nn.Module)):
        raise TypeError(f"activation_fn = {value!r} must be a class such as torch.nn.Tanh.")
    return value


def require_inverse_normalization(
    problem: LinearMPC, algorithm: BaseAlgorithm | None, observation: AffineObservation | None
) -> None:
    """Raise unless ``observation`` can undo what a VecNormalize does to the observations."""
    if algorithm is None:
        return
    normalize = algorithm.get_vec_normalize_env()
    if normalize is None:
        if getattr(algorithm, "sees_normalized", False) and algorithm.get_env() is not None:
            warn(LOST_STATISTICS)
        return
    require_frozen(normalize)
    if not normalize.norm_obs:
        return
    if observation is None:
        raise ValueError(
            "VecNormalize normalizes observations, and the law takes the state. Undo it: policy_"
            f"kwargs={{'observation': AffineObservation.from_vec_normalize(venv)}}. {IN_YAML}"
        )
    require_outermost(normalize, algorithm.observation_space.shape)
    vars(algorithm)["sees_normalized"] = True  # both are saved with the model
    vars(algorithm).setdefault("vec_normalize_statistics", statistics_of(normalize))
    largest = _largest_observation(problem, observation)
    if largest > normalize.clip_obs:
        raise ValueError(
            f"VecNormalize clips at clip_obs = {normalize.clip_obs:g}, but in the box of the law "
            f"normalized observations reach {largest:.4g}. Set venv.clip_obs = numpy.inf."
        )


def _largest_observation(problem: LinearMPC, observation: AffineObservation) -> float:
    """Return the largest entry that matters to theta over the box of the law, inf if not known."""
    matrix = observation.matrix[:, np.any(observation.matrix != 0, axis=0)]
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:  # theta does not tell what was observed
        return np.inf
    back = np.linalg.pinv(matrix)
    middle = (problem.theta_max + problem.theta_min) / 2 - observation.offset
    return float(np.max(np.abs(back @ middle) + np.abs(back) @ problem.theta_half))


def require_box(name: str, space: spaces.Space[Any], flattened: bool = False) -> None:
    """Raise unless the space is a Box of floats of one dimension, where no map makes theta."""
    if not isinstance(space, spaces.Box):
        raise TypeError(
            f"{name} is a {type(space).__name__}, YannPolicy needs a Box. "
            "Wrap the env so that observations and actions are vectors of real numbers."
        )
    if len(space.shape) != 1 and not flattened:
        raise ValueError(
            f"{name} has shape {space.shape}, YannPolicy needs one dimension, (n,). "
            "Wrap the env in gymnasium.wrappers.FlattenObservation, observe the plant's state, or "
            "pass policy_kwargs={'observation': AffineObservation(matrix, offset)}."
        )
    if name == "observation_space" and not (flattened or np.issubdtype(space.dtype, np.floating)):
        raise TypeError(
            f"{name} has dtype {space.dtype}: rounded to whole numbers, it is not the state. Use "
            "numpy.float32, or say what the numbers mean: policy_kwargs={'observation': "
            "AffineObservation(matrix, offset)}."
        )


def as_action_units(problem: LinearMPC, action_space: spaces.Box) -> ActionUnits:
    """Return how the env takes inputs; raise unless its bounds are those of the problem."""
    if not np.issubdtype(dtype := action_space.dtype, np.floating):
        raise TypeError(f"action_space has dtype {dtype}: inputs are real, use numpy.float32.")
    if not action_space.is_bounded():
        raise ValueError(f"action_space = {action_space} must have finite bounds.")
    units = ActionUnits.of(problem, action_space.low, action_space.high)
    if units is not None:
        return units
    raise ValueError(
        f"The action space is [{action_space.low.tolist()}, {action_space.high.tolist()}], but the "
        f"MPC has u_min = {problem.u_min.tolist()} and u_max = {problem.u_max.tolist()}. They must "
        "be the same, in plant units: build the LinearMPC with the bounds of the env, or rescale "
        "actions to [-1, 1] in all entries; retarget(model, mpc, env=) takes an env of the new "
        "bounds."
    )


def require_theta(
    problem: LinearMPC, observation_space: spaces.Space[Any], observation: AffineObservation | None
) -> None:
    """Raise unless theta is what is observed, or what ``observation`` makes of it."""
    shape = observation_space.shape
    if observation is None and shape == (problem.n_theta,):
        return
    takes = f"takes theta of shape ({problem.n_theta},), that is {', '.join(problem.labels())}"
    states_alone = shape == (problem.model.n_states,) != (problem.n_theta,)
    if observation is None or (states_alone and observation.n_obs == problem.n_theta):
        more = 0 if shape is None or len(shape) != 1 else shape[0] - problem.n_theta
        extra = f" Signals for networks alone are policy_kwargs={{'extra': {more}}}." * (more > 0)
        raise ValueError(
            f"The observation has shape {shape}, but the law of the problem {takes}. "
            f"{SHOW_THETA}{extra} Or pass the map from an observation to theta: "
            "policy_kwargs={'observation': AffineObservation(matrix, offset)}."
        )
    given = f"The map to theta has a matrix of shape {observation.matrix.shape}, but the"
    if shape is None or observation.n_obs != np.prod(shape):
        raise ValueError(
            f"{given} observation has shape {shape}: give it a column for each of its entries."
        )
    if observation.n_theta != problem.n_theta:
        raise ValueError(f"{given} law of the problem {takes}: give it {problem.n_theta} rows.")


def as_net_arch(
    value: dict[str, list[int]] | list[int] | None, shared: bool = False
) -> dict[str, list[int]]:
    """Return the hidden widths of actor (pi) and critic (qf), with defaults for what is missing."""
    known = {"pi": [64, 64] if shared else [16, 16], "qf": [64, 64]}
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


FIXED = LawLayer, AfterstateValue, QuadraticStateActionValue, AffineFeatures
"""Modules whose buffers follow from the problem, or from the map to its theta."""
FREE = {"clamped", "confines", "margin", "value_scale"}
"""Buffers of theirs that are not stored, or follow from what was learnt."""
OF_ORDER_ONE = {"offsets", "resting", "half_space_b", "change"}
"""Those that are in units of a range: zeros among them are not exact."""


class OtherProblemError(ValueError, RuntimeError):
    """Parameters are those of another problem than the policy's.

    torch says what does not fit by a RuntimeError, and `DDPG.load` hands on no other.
    """


def require_own_problem(module: nn.Module, state: Mapping[str, Any], strict: bool) -> None:
    """Raise unless what follows from the problem is in a state_dict as it is in the module."""
    for name, part in module.named_modules():
        if isinstance(part, FIXED):
            prefix = f"{name}." if name else ""
            if difference := _difference(part, prefix, state, strict):
                raise OtherProblemError(
                    "The parameters are those of a policy with another problem, observation or "
                    f"networks: {difference}. Load that model as a whole, DDPG.load(path), or load "
                    "them into a model that was made with the problem that they were trained with."
                )


def _difference(part: nn.Module, prefix: str, state: Mapping[str, Any], strict: bool) -> str:
    """Return in words what of a state_dict is not a module's own; nothing where all of it is."""
    own = {name: each for name, each in part.named_buffers(recurse=False) if name not in FREE}
    given = {key[len(prefix) :] for key in state if key.startswith(prefix)}
    given = {name for name in given if "." not in name} - FREE
    if strict and (missing := sorted(own.keys() - given)):
        return f"there is no {prefix}{missing[0]}"
    if strict and (unknown := sorted(given - own.keys())):
        return f"there is {prefix}{unknown[0]}, which this policy does not have"
    for name in sorted(own.keys() & given):
        value = state[f"{prefix}{name}"]
        wanted = own[name]
        if value.shape != wanted.shape:
            return f"{prefix}{name} has shape {tuple(value.shape)}, expected {tuple(wanted.shape)}"
        if not th.equal(value.to(wanted), wanted) and not _agree(part, name, value, wanted):
            return f"{prefix}{name} holds other numbers"
    return ""


def _agree(part: nn.Module, name: str, value: th.Tensor, wanted: th.Tensor) -> bool:
    """Return whether numbers are the same but for the rounding of another machine."""
    same_law = 1e-6  # a law that another machine has solved differs by less of each number
    if isinstance(part, SharedYannLayer) and name == "samples":
        return part.answers_as(value, same_law)
    ours = wanted.double().cpu()
    theirs = value.double().cpu()
    size = _largest(ours)
    if name in OF_ORDER_ONE:
        size = max(size, 1.0)
    if name == "middle":  # of the inputs, often zero: in their ranges
        ranges = "half_range" if isinstance(part, LawLayer) else "to_input"
        size = max(size, _largest(part.get_buffer(ranges)))
    return th.allclose(theirs, ours, rtol=same_law, atol=1e-9 * size)


def _largest(numbers: th.Tensor) -> float:
    return float(numbers[numbers.isfinite()].abs().max()) if numbers.numel() else 0.0
