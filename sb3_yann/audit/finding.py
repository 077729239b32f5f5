"""What an audit says, and how it says it."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_yann.audit.causes import Cause
from sb3_yann.audit.sample import Line, Sample
from sb3_yann_envs import ActionRepeat

_SUSPECTS = (
    "NormalizeReward",
    "ClipReward",
    "TransformReward",
    "DelayObservation",
    "NormalizeObservation",
    "RescaleObservation",
    "FlattenObservation",
    "TransformObservation",
    "MaxAndSkipObservation",
    "StickyAction",
    "RepeatAction",
    "RescaleAction",
    "ClipAction",
    "TransformAction",
)
_HARMLESS = {"FlattenObservation", "ClipAction"}


class CostMismatchWarning(UserWarning):
    """The env's reward is not minus the stage cost of the problem."""


class CostMismatchError(RuntimeError):
    """The same as an error, where `CostAudit` is strict.

    It is no ValueError: RL Zoo takes one of those in `learn` for a trial that went astray, and
    prunes it without a word.
    """


@dataclass(frozen=True)
class CostFinding:
    """What an audit has found.

    Attributes
    ----------
    matches : bool
        Whether the reward is what the problem and the policy say.
    cause : str
        A name for the likely cause, empty where there is no mismatch, "unknown" where there is one
        without an explanation.
    message : str
        All of it, in words.
    scale, offset, r2 : float
        The straight line ``reward = scale * (-cost) + offset`` that is nearest, and the share of
        the variance that it explains.
    steps : int
        Steps that were compared.
    wrappers : tuple of str
        Wrappers of the env that may have to do with it.

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

    @classmethod
    def match(cls, sample: Sample) -> CostFinding:
        """Return that there is nothing to find."""
        steps, line = int(sample.counted.sum()), Line.through(sample)
        message = f"The reward is the cost of the problem in all of {steps} steps."
        return cls(True, "", message, line.scale, line.offset, line.r2, steps, ())

    @classmethod
    def mismatch(cls, sample: Sample, cause: Cause, venv: VecEnv) -> CostFinding:
        """Return what is wrong, with the wrappers that may have to do with it."""
        steps, wrappers = int(sample.counted.sum()), suspects(venv)
        if steps == 0:  # nothing is finite, to be compared
            message = f"The rewards cannot be compared. Likely cause: {cause.explanation}"
            return cls(False, cause.name, message, np.nan, np.nan, np.nan, 0, wrappers)
        line = Line.through(sample)
        if cause.name == "not finite":
            message = f"The rewards cannot all be compared: {cause.explanation}"
            return cls(
                False, cause.name, message, line.scale, line.offset, line.r2, steps, wrappers
            )
        expected = "minus the cost of the problem"
        if (sample.scale, sample.offset) != (1, 0):
            expected = f"{sample.scale:g} * (-cost) {sample.offset:+g}, as the policy assumes"
        error = np.abs(sample.implied - sample.cost)[sample.counted]
        parts = [
            f"The reward is not {expected}: over {steps} steps the two differ by {error.mean():.3g}"
            f" on average, where the cost is {np.abs(sample.cost[sample.counted]).mean():.3g}.",
            f"Likely cause: {cause.explanation}",
            f"Wrappers of the env that may do this: {', '.join(wrappers)}." if wrappers else "",
            _in_numbers(line, cause),
        ]
        message = " ".join(part for part in parts if part)
        return cls(False, cause.name, message, line.scale, line.offset, line.r2, steps, wrappers)


def _in_numbers(line: Line, cause: Cause) -> str:
    found = (
        f"The nearest straight line is reward = {line.scale:.6g} * (-cost) {line.offset:+.6g}, "
        f"R² = {line.r2:.6f}."
    )
    if not (cause.scales and line.scale > 0 and line.r2 > 0.99):
        return found
    numbers = f'"reward_scale": {line.scale:.7g}, "reward_offset": {line.offset:.7g}'
    return f'{found} Where that is on purpose: policy_kwargs={{"critic": {{{numbers}}}}}.'


def suspects(venv: VecEnv) -> tuple[str, ...]:
    """Return the wrappers of the envs that change rewards, observations, actions or time.

    Also those in other processes, and the most special class of each only.
    """
    found: list[type] = []
    classes = [getattr(gymnasium.wrappers, name, None) for name in _SUSPECTS]
    for each in (ActionRepeat, *classes):
        if each is None or any(issubclass(special, each) for special in found):
            continue  # not in this version of Gymnasium, or named already
        if any(venv.env_is_wrapped(each)):
            found.append(each)
    return tuple(each.__name__ for each in found if each.__name__ not in _HARMLESS)
