"""What an audit says, and how it says it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_yann.audit.causes import Cause
from sb3_yann.audit.sample import Line, Sample
from sb3_yann_envs import ActionRepeat

_SUSPECTS = (
    "NormalizeReward ClipReward TransformReward DelayObservation NormalizeObservation "
    "RescaleObservation FlattenObservation TransformObservation MaxAndSkipObservation "
    "StickyAction RepeatAction RescaleAction ClipAction TransformAction"
).split()
"""Special classes come before the general ones that they derive from."""
_HARMLESS = {"FlattenObservation", "ClipAction"}


class CostMismatchWarning(UserWarning):
    """The env's reward is not minus the stage cost of the problem."""


class SteadyOffsetWarning(UserWarning):
    """Tracked outputs come to rest beside their references."""


class CostMismatchError(RuntimeError):
    """The same as an error, where `CostAudit` is strict.

    It is no ValueError: RL Zoo silently prunes a trial with one.
    """


@dataclass(frozen=True)
class CostFinding:
    """What an audit has found.

    Attributes
    ----------
    matches : bool
        Whether the reward is what the problem and the policy say.
    cause : str
        The likely cause, "unknown" where there is no explanation, empty where there is no mismatch.
    message : str
        All of it, in words.
    scale, offset, r2 : float
        The nearest line ``reward = scale * (-cost) + offset``, and the variance that it explains.
    steps : int
        Steps that were compared.
    wrappers : tuple of str
        Wrappers of the env that may have to do with it.
    rest : str
        How far tracked outputs rest beside their references, and the cure; empty where none does.

    Examples
    --------
    >>> CostFinding(True, "", "The reward is minus the cost.", 1.0, 0.0, 1.0, 100, ()).matches
    True
    """

    matches: bool
    cause: str
    message: str
    scale: float
    offset: float
    r2: float
    steps: int
    wrappers: tuple[str, ...]
    rest: str = ""


def make_finding(sample: Sample, cause: Cause | None, venv: VecEnv, rest: str = "") -> CostFinding:
    """Return what a cause of a mismatch says, or that there is none.

    Parameters
    ----------
    sample : Sample
        The steps.
    cause : Cause, optional
        The likely one.
    venv : VecEnv
        Whose wrappers are looked at.
    rest : str
        What is said of a steady offset.
    """
    steps = int(sample.counted.sum())
    line = Line.through(sample) if steps else Line(np.nan, np.nan, np.nan)
    if cause is None:
        message = f"The reward is the cost of the problem in all of {steps} steps."
        return CostFinding(True, "", message, line.scale, line.offset, line.r2, steps, (), rest)
    wrappers = _suspects(venv)
    if cause.name == "not finite":
        message = f"The rewards cannot all be compared: {cause.explanation}"
    else:
        message = " ".join(_in_words(sample, cause, wrappers, line))
    numbers = line.scale, line.offset, line.r2, steps
    return CostFinding(False, cause.name, message, *numbers, wrappers, rest)


def _in_words(sample: Sample, cause: Cause, wrappers: tuple[str, ...], line: Line) -> Iterator[str]:
    expected = "minus the cost of the problem"
    if (sample.scale, sample.offset) != (1, 0):
        expected = f"{sample.scale:g} * (-cost) {sample.offset:+g}, as the policy assumes"
    cost, error = sample.cost[sample.counted], (sample.implied - sample.cost)[sample.counted]
    yield (
        f"The reward is not {expected}: over {len(cost)} steps the two differ by "
        f"{np.abs(error).mean():.3g} on average, where the cost is {np.abs(cost).mean():.3g}."
    )
    yield f"Likely cause: {cause.explanation}"
    if wrappers:
        yield f"Wrappers of the env that may do this: {', '.join(wrappers)}."
    yield _in_numbers(line, cause)


def _in_numbers(line: Line, cause: Cause) -> str:
    found = (
        f"The nearest straight line is reward = {line.scale:.6g} * (-cost) {line.offset:+.6g}, "
        f"R² = {line.r2:.6f}."
    )
    if not (cause.scales and line.scale > 0 and line.r2 > 0.99):
        return found
    numbers = f'"reward_scale": {line.scale:.7g}, "reward_offset": {line.offset:.7g}'
    return f'{found} Where that is on purpose: policy_kwargs={{"critic": {{{numbers}}}}}.'


def _suspects(venv: VecEnv) -> tuple[str, ...]:
    """Return the wrappers of the envs that change rewards, observations, actions or time."""
    found: list[type] = []
    for each in (ActionRepeat, *(getattr(gymnasium.wrappers, name, None) for name in _SUSPECTS)):
        if each is None or any(issubclass(special, each) for special in found):
            continue  # not in this version of Gymnasium, or named already
        if any(venv.env_is_wrapped(each)):  # in other processes too
            found.append(each)
    return tuple(each.__name__ for each in found if each.__name__ not in _HARMLESS)
