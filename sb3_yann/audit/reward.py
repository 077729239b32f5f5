"""Whether rewards are minus the problem's stage cost, and in which way they are not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_yann._validation import Array
from sb3_yann_envs import ActionRepeat

EXACT = 1e-5
"""What rounding to float32 leaves of an agreement, relative to the spread of the rewards."""
MIN_STEPS = 10
"""Steps that must be compared."""

_EFFECTS = {
    "NormalizeReward": "divides rewards by running statistics: leave it out, reward_scale is for a "
    "constant factor",
    "ClipReward": "clips rewards, and the critic's cost goes on beyond that: leave it out",
    "TransformReward": "changes rewards",
    "DelayObservation": "shows an earlier observation, and the law needs the present state: leave "
    "it out",
    "NormalizeObservation": "changes observations: pass policy_kwargs={'observation': ...}",
    "RescaleObservation": "changes observations: pass policy_kwargs={'observation': ...}",
    "FlattenObservation": "",
    "TransformObservation": "changes observations: pass policy_kwargs={'observation': ...}",
    "MaxAndSkipObservation": "repeats actions",
    "StickyAction": "does not always take the action: leave it out",
    "RepeatAction": "repeats actions: the MPC needs the sampling time and weights of all of them",
    "RescaleAction": "changes actions: build the LinearMPC for the inputs that the env takes",
    "ClipAction": "",
    "TransformAction": "changes actions",
}
"""What Gymnasium's wrappers do; special classes come before those that they derive from."""


class CostMismatchWarning(UserWarning):
    """The env's reward is not minus the stage cost of the problem."""


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
        "not finite", "constant", "sign flipped", "scaled", "scaled and shifted", "next state",
        "normalized reward" or "observation" of a VecNormalize, or "unknown"; empty where there is
        no mismatch.
    message : str
        All of it, in words.
    scale, offset, r2 : float
        The nearest line ``reward = scale * (-cost) + offset``, and the variance that it explains.
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


@dataclass(frozen=True)
class Steps:
    """The first steps of training whose rewards should be the problem's.

    Attributes
    ----------
    theta, following : ndarray, shape (steps, n), before and after the step, in deviations
    u : ndarray, shape (steps, m), in deviations
    rewards : ndarray, shape (steps,)
    rounding : ndarray, shape (steps, n), by how much theta may err, from float32 observations
    scale, offset : float, for the reward ``scale * (-cost) + offset``
    stage_cost : callable, (steps, n), (steps, m) to (steps,)
    """

    theta: Array
    following: Array
    u: Array
    rewards: Array
    rounding: Array
    scale: float
    offset: float
    stage_cost: Callable[[Array, Array], Array]

    @cached_property
    def cost(self) -> Array:
        """The problem's cost of each step, (steps,)."""
        return self.stage_cost(self.theta, self.u)

    @cached_property
    def implied(self) -> Array:
        """The cost of each step that the reward stands for, (steps,)."""
        return (self.offset - self.rewards) / self.scale

    @cached_property
    def rounded(self) -> Array:
        """By how much the cost of each step may err because observations are float32, (steps,)."""
        total: Array = np.zeros(len(self.cost))
        for i, unit in enumerate(np.eye(self.theta.shape[1])):
            nearby = self.theta + self.rounding[:, i : i + 1] * unit
            total = total + np.abs(self.stage_cost(nearby, self.u) - self.cost)
        return 2 * total

    def match(self, tolerance: float) -> bool:
        """Tell whether every reward is what the problem says."""
        cost = np.abs(self.cost)
        allowed = tolerance * np.maximum(cost, cost.mean()) + self.rounded
        at_rest = 1e-9 * np.abs(self.rewards).max() + 1e-12
        return bool(np.all(np.abs(self.implied - self.cost) <= allowed + at_rest))

    def agree(self, predicted: Array, tolerance: float) -> bool:
        """Tell whether nearly all rewards are minus a predicted cost (steps,).

        Errors are relative to how much it varies: a large constant explains nothing.
        """
        spread = np.abs(predicted - np.median(predicted))
        allowed = tolerance * np.maximum(spread, spread.mean()) + self.rounded
        return bool(np.mean(np.abs(self.implied - predicted) <= allowed) >= 0.98)


@dataclass(frozen=True)
class Line:
    """The line nearest to ``reward = scale * (-cost) + offset``, and its share of the variance."""

    scale: float
    offset: float
    r2: float

    @classmethod
    def through(cls, steps: Steps) -> Line:
        """Return the line by least squares, through the origin where that does as well."""
        x = -steps.cost
        y = steps.rewards
        if not len(y):
            return cls(np.nan, np.nan, np.nan)
        if np.ptp(x) <= 1e-12 * np.abs(x).max() or np.ptp(y) <= 1e-12 * np.abs(y).max():
            return cls(0.0, float(y.mean()), 0.0)
        # Centered: with a large offset the normal equations would lose what varies.
        dx, dy = x - x.mean(), y - y.mean()
        scale = float(dx @ dy / (dx @ dx))
        offset = float(y.mean() - scale * x.mean())
        if abs(offset) <= EXACT * np.abs(y).mean():
            scale, offset = float(x @ y / (x @ x)), 0.0
        residual = y - scale * x - offset
        return cls(scale, offset, float(1 - residual @ residual / (dy @ dy)))


def likely_cause(steps: Steps, line: Line, tolerance: float) -> tuple[str, str]:
    """Return the name of what explains the rewards, and a sentence.

    Near a steady state many explanations are nearly right, hence exact ones go first.
    """
    if np.ptp(steps.rewards) <= 1e-9 * np.abs(steps.rewards).max():
        return "constant", f"every reward is {steps.rewards[0]:g}, whatever happens."
    on_line = (steps.offset - line.scale * -steps.cost - line.offset) / steps.scale
    after = steps.stage_cost(steps.following, steps.u)
    for width in (EXACT, tolerance):
        if line.scale != 0 and steps.agree(on_line, width):
            return _scaled(line)
        if steps.agree(after, width):
            return "next state", (
                "the cost is c(s', u), of the state after the step, where the problem has c(s, u). "
                "Compute it before the env steps; where observations are late, leave the delay out."
            )
    return "unknown", (
        "none that the audit knows. Compare the env's reward with problem.stage_cost(theta, u) "
        "step by step: weights, units, what an observation means, whether actions are repeated."
    )


def _scaled(line: Line) -> tuple[str, str]:
    if line.scale < 0:
        size = "" if abs(line.scale + 1) < 1e-3 else f" (times {-line.scale:.6g})"
        return "sign flipped", (
            f"the env returns the cost itself{size} as its reward. The learner would maximize it: "
            "return minus the cost."
        )
    found = f"the reward is {line.scale:.6g} times minus the cost"
    if line.offset == 0:
        why = "another unit, a factor dt, or an action that is repeated."
        return "scaled", f"{found}: {why}"
    why = "a bonus for each step, or a cost of what is not zero at the origin."
    return "scaled and shifted", f"{found}, plus {line.offset:.6g}: {why}"


def mismatch_in_words(
    steps: Steps, line: Line, explanation: str, wrappers: tuple[str, ...]
) -> Iterator[str]:
    """Yield what is said of rewards that are not the problem's, sentence by sentence."""
    expected = "minus the cost of the problem"
    if (steps.scale, steps.offset) != (1, 0):
        expected = f"{steps.scale:g} * (-cost) {steps.offset:+g}, as the policy assumes"
    error = np.abs(steps.implied - steps.cost)
    yield (
        f"The reward is not {expected}: over {len(error)} steps the two differ by "
        f"{error.mean():.3g} on average, where the cost is {np.abs(steps.cost).mean():.3g}."
    )
    yield f"Likely cause: {explanation}"
    if wrappers:
        named = [f"{name} {_EFFECTS.get(name, _EFFECTS['RepeatAction'])}" for name in wrappers]
        yield f"Wrappers of the env that may do this: {'; '.join(named)}."
    yield (
        f"The nearest straight line is reward = {line.scale:.6g} * (-cost) {line.offset:+.6g}, "
        f"R² = {line.r2:.6f}."
    )
    if line.scale > 0 and line.r2 > 0.99:
        numbers = f'"reward_scale": {line.scale:.7g}, "reward_offset": {line.offset:.7g}'
        yield f'Where that is on purpose: policy_kwargs={{"critic": {{{numbers}}}}}.'


def not_finite(lost: NDArray[np.bool_], rewards: Array, n_envs: int) -> str:
    """Return that rewards or observations are lost, and which was the first.

    Parameters
    ----------
    lost : ndarray of bool, shape (steps,)
        Which steps, those of several envs in turns.
    rewards : ndarray, shape (steps,)
        Of all steps.
    n_envs : int
        Number of envs.
    """
    first = int(np.argmax(lost))
    reward = rewards[first]
    what = "an observation" if np.isfinite(reward) else f"the reward, {reward:g},"
    return (
        f"in {lost.sum()} of {len(lost)} steps a reward or an observation is not a finite number, "
        f"first {what} of step {first // n_envs + 1}: the env or a sensor fails. The steps are "
        "left out."
    )


def wrappers_of(venv: VecEnv) -> tuple[str, ...]:
    """Return the wrappers of the envs that change rewards, observations, actions or time."""
    found: list[type] = []
    for each in (ActionRepeat, *(getattr(gymnasium.wrappers, name, None) for name in _EFFECTS)):
        if each is None or any(issubclass(special, each) for special in found):
            continue  # not in this version of Gymnasium, or named already
        if any(venv.env_is_wrapped(each)):  # in other processes too
            found.append(each)
    return tuple(each.__name__ for each in found if _EFFECTS.get(each.__name__, "else"))
