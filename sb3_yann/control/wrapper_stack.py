"""What an env's wrappers make of its state: the one walk through them, for all who meet an env."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_yann._validation import warn
from sb3_yann.control.observer import StateEstimator
from sb3_yann.units import ActionUnits

if TYPE_CHECKING:
    from sb3_yann.control.mpc.problem import MPCProblem

WRAPPER_LIBRARIES = {"gymnasium", "stable_baselines3"}
LEAVE_OUT = (
    "Leave it out. For observations that are scaled by fixed numbers, pass "
    "policy_kwargs={'observation': AffineObservation.normalized(mean, std)}."
)


def layers_of(env: Any) -> Iterator[Any]:
    """Yield an env and all that it wraps, outermost first; of a vector env its envs in turn."""
    yield env
    held = getattr(env, "__dict__", {})
    inner = [held[name] for name in ("venv", "env") if held.get(name) is not None]
    for each in [*inner, *(held.get("envs") or [])]:
        yield from layers_of(each)


SHOW_THETA = (
    "Wrap the env so that it shows all of theta: SetPoint, MeasuredDisturbance, EstimateState (of "
    "outputs), ObserveDisturbance and PreviousInput in sb3_yann.wrappers append what is missing, "
    "PastInputs what is on its way."
)


def require_theta_order(env: Any, problem: MPCProblem) -> None:
    """Raise ValueError where our wrappers append what has another place in theta, or another model.

    Of a vector env the first env counts; below a wrapper that shows another size, nothing does.
    Warn of set-points beyond those of the problem.
    """
    layout = problem.layout
    end = layout.size
    for layer in layers_of(env):
        if parts := getattr(type(layer), "appends", ()):
            start = end - len(layer.low)
            slots = [getattr(layout, part) for part in parts]
            fits = any(slot.start <= start and end <= slot.stop for slot in slots)
            if start < end and not fits:
                raise ValueError(
                    f"{type(layer).__name__} appends its values at another place than theta = "
                    f"[{', '.join(problem.labels())}] has them. From the inside outward it is "
                    "PastInputs, SetPoint, MeasuredDisturbance, ObserveDisturbance, SetPoint of "
                    "bounds that change, PreviousInput."
                )
            if start < end and "reference" in parts:
                _warn_of_wide(layer, problem, slice(start, end))
            observer = vars(layer).get("observer")
            if isinstance(observer, StateEstimator):
                observer.require_model(problem.model)
            if observer is not None or "previous" in parts:
                _require_plant_inputs(layer, problem)
            end = start
        elif "envs" not in vars(layer) and "venv" not in vars(layer):
            inner = vars(layer).get("env")
            if inner is None or inner.observation_space.shape != layer.observation_space.shape:
                return


def _require_plant_inputs(layer: Any, problem: MPCProblem) -> None:
    """Raise where a wrapper that keeps inputs sees them normalized: in theta they are not."""
    units = ActionUnits.of(problem, layer.inputs.low, layer.inputs.high)
    if units is not None and units.kind == "normalized":
        raise ValueError(
            f"{type(layer).__name__} sees inputs from -1 to 1, and those of the MPC lie between "
            f"{problem.u_min.tolist()} and {problem.u_max.tolist()}. Inside of it wrap the env in "
            "gymnasium.wrappers.RescaleAction(env, mpc.u_min, mpc.u_max), which takes plant units."
        )


def _warn_of_wide(layer: Any, problem: MPCProblem, slots: slice) -> None:
    """Warn where a wrapper draws set-points from beyond their box."""
    low = problem.theta_min[slots]
    high = problem.theta_max[slots]
    room = 1e-3 * (high - low)
    for i in np.flatnonzero((layer.low < low - room) | (layer.high > high + room))[:1]:
        warn(
            f"{type(layer).__name__} shows {problem.labels()[slots][i]} from {layer.low[i]:g} to "
            f"{layer.high[i]:g}, and the MPC takes one beyond {low[i]:g} to {high[i]:g} as at its "
            "end. Give both the same range."
        )


def require_state_shown(env: Any, observation_given: bool) -> None:
    """Raise ValueError unless an observation means the same state at any time.

    Not so where a wrapper scales by statistics of its own. Unless the user said what is shown,
    ``observation_given``, it must be the parameter of the law: neither rescaled nor stacked.
    Unknown wrappers pass, and a `VecNormalize` is not examined. Where states are late or inputs
    are not applied, it warns. Wrappers may be in other processes.
    """
    for layer in layers_of(env):
        name = type(layer).__name__
        if _keeps_statistics(layer):
            raise ValueError(
                f"{name} scales observations or actions by statistics of its own, which move: the "
                f"same number means another state at each step, and the law takes the state. "
                f"{LEAVE_OUT}"
            )
        if not observation_given and (undo := _other_observation(layer)):
            raise ValueError(
                f"{name} shows other numbers than the state that the law takes. Say what they "
                f"mean: policy_kwargs={{'observation': {undo}}}, or AffineObservation.identity(n) "
                "where the model is one of what is shown. A law without a policy takes the env "
                "without the wrapper; RL Zoo's hyperparameters need no frame_stack."
            )
        if not observation_given and (
            late := _library_names(layer) & {"DelayObservation", "StickyAction"}
        ):
            what = "shows past states" if "DelayObservation" in late else "repeats past inputs"
            warn(
                f"{name} {what}, and the law is one of the present state and input. Leave it out, "
                "or put the inputs that are under way into the model's state."
            )
        is_wrapped = getattr(layer, "env_is_wrapped", None)
        if is_wrapped is not None and "envs" not in vars(layer) and "venv" not in vars(layer):
            for kind in (KeepsStatistics, *(() if observation_given else (ShowsOtherNumbers,))):
                if any(is_wrapped(kind)):
                    raise ValueError(
                        f"A wrapper in the processes of {name} {kind.__doc__} The law takes the "
                        f"state. {LEAVE_OUT}"
                    )


def warn_of_moving_rewards(env: Any) -> None:
    """Warn where a learner's rewards are divided by a statistic, which moves."""
    for layer in layers_of(env):
        if "NormalizeReward" in _library_names(layer) and layer.update_running_mean:
            warn(
                "NormalizeReward divides rewards by a statistic that moves: they are not minus the "
                "stage cost, for which the critic stands, so that it learns its value anew. The "
                "law stays. Leave the wrapper out; the critic finds its scale itself."
            )


def _library_names(layer: Any) -> set[str]:
    """Return the names of a layer's classes that are a library's."""
    kinds = type(layer).__mro__
    return {each.__name__ for each in kinds if each.__module__.split(".")[0] in WRAPPER_LIBRARIES}


def _keeps_statistics(layer: Any) -> bool:
    """Tell whether a layer holds means and spreads of what it passes on, and moves them.

    Those of rewards, which have no entry for each observation, do not count.
    """
    if "VecNormalize" in _library_names(layer):
        return False  # what it says can be undone, once it is frozen
    if getattr(layer, "update_running_mean", None) is False:
        return False  # gymnasium's NormalizeObservation, frozen: fixed numbers
    held = {name.lower(): value for name, value in getattr(layer, "__dict__", {}).items()}
    shapes = _shapes(layer)
    for value in held.values():  # an object of its own, as gymnasium and Stable-Baselines3 have
        moves = hasattr(value, "var") and (hasattr(value, "update") or hasattr(value, "count"))
        if moves and _shape(getattr(value, "mean", None)) in shapes:
            return True
    of_entries = " ".join(name for name, value in held.items() if _shape(value) in shapes)
    if any(part in of_entries for part in ("running", "moving", "ema_")):
        return True
    spreads = any(part in of_entries for part in ("var", "std", "m2", "sigma"))
    counts = {name.strip("_") for name in held} & {"count", "n", "num", "n_samples", "n_seen"}
    return "mean" in of_entries and spreads and bool(counts)


def _shapes(layer: Any) -> set[tuple[int, ...]]:
    """Return the shapes of a layer's observations and actions, on both sides of it."""
    kinds = ("observation_space", "action_space", "single_observation_space", "single_action_space")
    sides = [layer, *(vars(layer).get(name) for name in ("env", "venv") if hasattr(layer, name))]
    spaces = [getattr(side, kind, None) for side in sides for kind in kinds]
    return {shape for space in spaces if (shape := getattr(space, "shape", None))}


def _shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of numbers, None of anything else."""
    if not isinstance(value, list | tuple) and not hasattr(value, "shape"):
        return None
    try:
        return tuple(np.shape(value))
    except (TypeError, ValueError):  # a class, a list of unequal ones
        return None


def _other_observation(layer: Any) -> str:
    """Return the map that undoes a library's wrapper, empty where there is nothing to undo."""
    names = _library_names(layer)
    if "NormalizeObservation" in names:  # a frozen one: the others have been refused
        return _normalized(layer.obs_rms.mean, np.sqrt(layer.obs_rms.var + layer.epsilon))
    if "RescaleObservation" in names:
        shown, meant = (
            getattr(each, "single_observation_space", each.observation_space)
            for each in (layer, layer.env)
        )
        if np.array_equal([shown.low, shown.high], [meant.low, meant.high]):
            return ""
        low, high = (np.asarray(each, np.float64) for each in (meant.low, meant.high))
        scale = (high - low) / (np.asarray(shown.high, np.float64) - shown.low)
        return _normalized(low - scale * shown.low, scale)
    if names & {"VecFrameStack", "FrameStackObservation"}:
        held = vars(layer)
        frames = held.get("n_stack") or held.get("stack_size") or held["stacked_obs"].n_stack
        inner = held.get("venv") or held.get("env")
        size = int(np.prod(inner.observation_space.shape))
        return f"AffineObservation.newest_frame({size}, {frames})" if frames > 1 else ""
    return ""


def _normalized(mean: Any, std: Any) -> str:
    return f"AffineObservation.normalized({np.ravel(mean).tolist()}, {np.ravel(std).tolist()})"


class _Judged(type):
    """Classes whose instances are recognized by what they hold: a worker process can ask too."""

    def __instancecheck__(cls, layer: Any) -> bool:
        return bool(cls.judge(layer))  # type: ignore[attr-defined]


class KeepsStatistics(metaclass=_Judged):
    """scales observations or actions by statistics of its own."""

    judge = staticmethod(_keeps_statistics)


class ShowsOtherNumbers(metaclass=_Judged):
    """rescales or stacks observations."""

    judge = staticmethod(_other_observation)
