"""Whether rewards are minus the stage cost, in which way they are not; a callback that says so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._progress import say
from sb3_yann._validation import Array, check_bool, check_int, check_positive, warn
from sb3_yann.audit.meaning import CostMismatchError, CostMismatchWarning, warn_of_order
from sb3_yann.policy.observations import require_frozen
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import may_change_reward

EXACT = 1e-5  # what rounding to float32 leaves of an agreement, relative to the rewards' spread
MIN_STEPS = 10  # steps that must be compared


@dataclass(frozen=True)
class CostFinding:
    """What an audit has found.

    Attributes
    ----------
    matches : bool
        Whether the reward is what the problem and the policy say.
    cause : str
        "constant", "sign flipped", "scaled", "scaled and shifted", "next state", "normalized
        reward" or "observation" of a VecNormalize, or "unknown"; empty where there is no mismatch.
    message : str
        All of it, in words.
    scale, offset, r2 : float
        The nearest line ``reward = scale * (-cost) + offset``, and the variance that it explains.
    steps : int
        Steps that were compared.

    Examples
    --------
    >>> CostFinding(True, "", "The reward is minus the cost.", 1.0, 0.0, 1.0, 100).matches
    True
    """

    matches: bool
    cause: str
    message: str
    scale: float
    offset: float
    r2: float
    steps: int


class Line(NamedTuple):
    """The line nearest to ``reward = scale * (-cost) + offset``, and its share of the variance."""

    scale: float
    offset: float
    r2: float

    @classmethod
    def through(cls, x: Array, y: Array) -> Line:
        """Return the line by least squares, through the origin where that does as well."""
        if np.ptp(x) <= 1e-12 * np.abs(x).max() or np.ptp(y) <= 1e-12 * np.abs(y).max():
            return cls(0.0, float(y.mean()), 0.0)
        # Centered: with a large offset the normal equations would lose what varies.
        dx = x - x.mean()
        dy = y - y.mean()
        scale = float(dx @ dy / (dx @ dx))
        offset = float(y.mean() - scale * x.mean())
        if abs(offset) <= EXACT * np.abs(y).mean():
            scale = float(x @ y / (x @ x))
            offset = 0.0
        residual = y - scale * x - offset
        return cls(scale, offset, float(1 - residual @ residual / (dy @ dy)))

    @property
    def cause(self) -> tuple[str, str]:
        """The name of what makes such rewards, and a sentence."""
        if self.scale < 0:
            return "sign flipped", (
                f"the env returns the cost itself, times {-self.scale:.6g}, as its reward. The "
                "learner would maximize it: return minus the cost."
            )
        found = f"the reward is {self.scale:.6g} times minus the cost"
        if self.offset == 0:
            return "scaled", f"{found}: another unit, a factor dt, or an action that is repeated."
        why = "a bonus for each step, or a cost of what is not zero at the origin."
        return "scaled and shifted", f"{found}, plus {self.offset:.6g}: {why}"


class Rewards(NamedTuple):
    """Costs (steps,) that rewards stand for, beside those of the state before and after a step.

    Costs may err by what is ``rounded``, of float32 observations.
    """

    rewards: Array
    implied: Array
    cost: Array
    after: Array
    rounded: Array

    def match(self, tolerance: float) -> bool:
        """Tell whether every reward is what the problem says."""
        cost = np.abs(self.cost)
        allowed = tolerance * np.maximum(cost, cost.mean()) + self.rounded
        at_rest = 1e-9 * np.abs(self.rewards).max() + 1e-12
        return bool(np.all(np.abs(self.implied - self.cost) <= allowed + at_rest))

    def agree(self, costs: Array, predicted: Array, tolerance: float) -> bool:
        """Tell whether nearly all costs (steps,) are those predicted, relative to their spread."""
        spread = np.abs(predicted - np.median(predicted))
        allowed = tolerance * np.maximum(spread, spread.mean()) + self.rounded
        return bool(np.mean(np.abs(costs - predicted) <= allowed) >= 0.98)

    def likely_cause(self, line: Line, tolerance: float) -> tuple[str, str]:
        """Return the name of what explains the rewards, and a sentence.

        Near a steady state many explanations are nearly right, hence exact ones go first.
        """
        if np.ptp(self.rewards) <= 1e-9 * np.abs(self.rewards).max():
            return "constant", f"every reward is {self.rewards[0]:g}, whatever happens."
        of_line = (line.offset - self.rewards) / (line.scale or 1.0)
        for width in (EXACT, tolerance):
            if line.scale != 0 and self.agree(of_line, self.cost, width):
                return line.cause
            if self.agree(self.implied, self.after, width):
                return "next state", (
                    "the cost is c(s', u), of the state after the step, where the problem has "
                    "c(s, u). Compute it before the env steps; leave a delay out."
                )
        return "unknown", (
            "none that the audit knows. Compare the env's reward with problem.stage_cost(theta, u) "
            "step by step: weights, units, the rest (x_ss, u_ss) that distances count from, what "
            "an observation means, repeated actions, wrappers that change rewards, observations, "
            "actions or time."
        )


class CostAudit(BaseCallback):
    """Checks that the env's reward and observation mean what the problem says, and names what not.

    Actor and critic are exact only where the reward is minus the stage cost, scaled and shifted as
    the policy's :class:`CriticOptions` say. The audit compares the first steps of every `learn`,
    and names a likely cause. Steps with ``info["violation"]``, and those
    that terminate an episode, may cost more. While the plant rests it sees nothing.

    Parameters
    ----------
    steps : int, default 100
        Steps to compare, of all envs together. Fewer than ten say nothing.
    tolerance : float, default 1e-3
        The largest error of a reward that passes, relative to its own or the mean cost.
    strict : bool, default False
        Whether a mismatch ends training with a :class:`CostMismatchError`, instead of a
        :class:`CostMismatchWarning`.
    verbose : int, default 0
        1 prints that the rewards match.

    Attributes
    ----------
    finding : CostFinding or None
        What was found, once enough steps have been seen.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> audit = CostAudit(steps=20)
    >>> model = DDPG("YannPolicy", "CSTR-v0", seed=0, learning_starts=0, device="cpu")
    >>> _ = model.learn(25, callback=audit)
    >>> audit.finding.matches
    True
    """

    model: OffPolicyAlgorithm
    order_checked = False  # a guard has done it itself

    def __init__(
        self, steps: int = 100, tolerance: float = 1e-3, strict: bool = False, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.steps = check_int("steps", steps, MIN_STEPS, "Fewer say nothing.")
        self.tolerance = check_positive("tolerance", tolerance, "Rounding is no mismatch.")
        self.strict = check_bool("strict", strict)
        self.finding: CostFinding | None = None

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "CostAudit")
        watch_buffer(self.model)
        self.finding = None
        self._records: list[tuple[Any, ...]] = []

    def _on_step(self) -> bool:
        if self.finding is None and len(self._records) < self.steps:
            self._record()
            if len(self._records) >= self.steps:
                self._judge()
        return True

    def _on_training_end(self) -> None:
        if self.finding is None and self._records:
            self._judge()

    def _record(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        # The buffer holds what VecNormalize has not touched, and normalizes samples of it.
        rewards = self.locals["rewards"] if normalize is None else normalize.get_original_reward()
        # As SB3 makes what the env is given, anew: an env may write into that.
        policy = self.model.policy
        space: Any = self.model.action_space
        if "buffer_actions" in self.locals:
            actions = policy.unscale_action(self.locals["buffer_actions"])
        elif policy.squash_output:
            actions = policy.unscale_action(self.locals["actions"])
        else:
            actions = np.clip(self.locals["actions"], space.low, space.high)
        for i, info in enumerate(self.locals["infos"]):
            done = bool(self.locals["dones"][i])
            terminated = done and not info.get("TimeLimit.truncated", False)
            following = info["terminal_observation"] if done else self.locals["new_obs"][i]
            # Copies: an env may write into its arrays.
            seen = np.array(self.model._last_obs[i]), np.array(following)  # type: ignore[index]
            counted = not (may_change_reward(info) or terminated)
            action = np.array(actions[i], dtype=np.float64)
            self._records.append((*seen, action, float(rewards[i]), counted))

    def _judge(self) -> None:
        columns = [*map(np.array, zip(*self._records, strict=True))]
        flat = [each.reshape(len(each), -1) for each in columns[:2]]
        finite = np.isfinite(np.hstack([*flat, columns[3][:, None]])).all(axis=1)
        if not finite.any():
            return
        before, after, actions, rewards, counted = (each[finite] for each in columns)
        theta, following = (
            np.asarray(self.policy.theta(each).double().cpu().numpy()) for each in (before, after)
        )
        u = self.policy.inputs(actions)
        seen = theta, following, u, rewards, self._rounding(before)
        compared = self._compared(*(each[counted] for each in seen))
        count = len(compared.rewards)
        if count < MIN_STEPS:  # what is not finite has had its own warning
            return
        if not self.order_checked:
            self.policy.states_checked = True
            warn_of_order(self.policy.problem, theta, u, following)
        line = Line.through(-compared.cost, compared.rewards)
        cause, explanation = self._vec_normalize_switched_on()
        if not cause and not compared.match(self.tolerance):
            cause, explanation = compared.likely_cause(line, self.tolerance)
        message = f"The reward is the cost of the problem in all of {count} steps."
        message = self._in_words(compared, line, explanation) if cause else message
        self._records = []
        self.finding = CostFinding(not cause, cause, message, *line, count)
        if not cause:
            if self.verbose:
                say(f"Cost audit: {message}")
        elif self.strict:
            raise CostMismatchError(message)
        else:
            warn(message, CostMismatchWarning)

    def _compared(
        self, theta: Array, following: Array, u: Array, rewards: Array, rounding: Array
    ) -> Rewards:
        """Return what rewards should be, in deviations; theta may err by a ``rounding``."""
        options = self.policy.critic_options
        stage_cost = self.policy.problem.deviations.stage_cost
        cost = stage_cost(theta, u)
        rounded: Array = np.zeros(len(cost))
        for i, unit in enumerate(np.eye(theta.shape[1])):
            rounded += 2 * np.abs(stage_cost(theta + rounding[:, i : i + 1] * unit, u) - cost)
        implied = (options.reward_offset - rewards) / options.reward_scale
        return Rewards(rewards, implied, cost, stage_cost(following, u), rounded)

    def _in_words(self, compared: Rewards, line: Line, explanation: str) -> str:
        """Return what is said of rewards that are not the problem's."""
        options = self.policy.critic_options
        scale = options.reward_scale
        offset = options.reward_offset
        expected = "minus the cost of the problem"
        if (scale, offset) != (1, 0):
            expected = f"{scale:g} * (-cost) {offset:+g}, as the policy assumes"
        error = np.abs(compared.implied - compared.cost)
        sentences = [
            f"The reward is not {expected}: over {len(error)} steps the two differ by "
            f"{error.mean():.3g} on average, where the cost is {np.abs(compared.cost).mean():.3g}.",
            f"Likely cause: {explanation}",
            f"The nearest straight line is reward = {line.scale:.6g} * (-cost) {line.offset:+.6g}, "
            f"R² = {line.r2:.6f}.",
        ]
        if line.scale > 0 and line.r2 > 0.99:
            numbers = f'"reward_scale": {line.scale:.7g}, "reward_offset": {line.offset:.7g}'
            on_purpose = f'policy_kwargs={{"critic": {{{numbers}}}}}'
            sentences.append(f"Where that is on purpose: {on_purpose}.")
        return " ".join(sentences)

    def _rounding(self, observations: Array) -> Array:
        """Return by how much theta may err, (steps, n_theta); see AffineObservation."""
        digits = observations.dtype if observations.dtype.kind == "f" else np.float64
        size = np.abs(observations).astype(np.float64).reshape(len(observations), -1)
        if (seen := self.policy.to_theta) is not None:
            # What a normalization hides of its size is in the offset.
            size = size @ np.abs(seen.matrix).T + np.abs(seen.offset)
        return np.asarray(size * float(np.finfo(digits).eps))

    def _vec_normalize_switched_on(self) -> tuple[str, str]:
        """Return what has been set since the policy was built and let it pass, empty for none."""
        if (normalize := self.model.get_vec_normalize_env()) is None:
            return "", ""
        try:
            require_frozen(normalize)
        except ValueError as error:
            return f"normalized {'reward' if normalize.norm_reward else 'observation'}", str(error)
        return "", ""
