"""The callback that compares the first rewards of training with the problem's stage cost."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, check_bool, check_int, check_positive
from sb3_yann.audit.meaning import warn_of_order
from sb3_yann.audit.reward import (
    MIN_STEPS,
    CostFinding,
    CostMismatchError,
    CostMismatchWarning,
    Line,
    Steps,
    likely_cause,
    mismatch_in_words,
    not_finite,
    wrappers_of,
)
from sb3_yann.policy.observations import require_frozen
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import may_change_reward


class CostAudit(BaseCallback):
    """Checks that the env's reward and observation mean what the problem says, and names what not.

    Actor and critic are exact only where the reward is minus the stage cost, scaled and shifted as
    the policy's :class:`CriticOptions` say. The audit compares the first steps of every `learn`,
    and names a likely cause and wrappers of the env. Steps with ``info["violation"]``, and those
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
    >>> model = DDPG("YannPolicy", "CSTR-v0", seed=0, learning_starts=30, device="cpu")
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
        self._records: list[dict[str, Any]] = []

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
        # On-policy algorithms call what the env took "clipped".
        actions = self.locals.get("clipped_actions", self.locals["actions"])
        for i, info in enumerate(self.locals["infos"]):
            done = bool(self.locals["dones"][i])
            terminated = done and not info.get("TimeLimit.truncated", False)
            following = info["terminal_observation"] if done else self.locals["new_obs"][i]
            self._records.append(
                {
                    "observation": np.array(self.model._last_obs[i]),  # type: ignore[index]
                    "following": np.array(following),  # copies: an env may write into its arrays
                    "action": np.array(actions[i], dtype=np.float64),
                    "reward": float(rewards[i]),
                    "counted": not (may_change_reward(info) or terminated),
                }
            )

    def _judge(self) -> None:
        names = self._records[0]
        records = {name: np.array([each[name] for each in self._records]) for name in names}
        shown = records["observation"], records["following"]
        finite = np.isfinite(records["reward"])
        for each in shown:
            finite &= np.isfinite(each.reshape(len(finite), -1)).all(axis=1)
        lost = ~finite
        theta, following = (self._theta(each[finite]) for each in shown)
        u = self.policy.inputs(records["action"][finite])
        counted = records["counted"][finite]
        steps = self._steps(
            theta[counted],
            following[counted],
            u[counted],
            records["reward"][finite][counted],
            shown[0][finite][counted],
        )
        enough = len(steps.rewards) >= MIN_STEPS
        if not enough and not lost.any():
            return
        if not self.order_checked:
            warn_of_order(self.policy.problem, theta, u, following, stacklevel=2)
        line = Line.through(steps)
        cause, explanation = self._vec_normalize_switched_on()
        if not cause and enough and not steps.match(self.tolerance):
            cause, explanation = likely_cause(steps, line, self.tolerance)
        wrappers: tuple[str, ...] = ()
        message = f"The reward is the cost of the problem in all of {len(steps.rewards)} steps."
        if cause:
            wrappers = wrappers_of(self.training_env)
            message = " ".join(mismatch_in_words(steps, line, explanation, wrappers))
        if lost.any():
            fault = not_finite(lost, records["reward"], self.training_env.num_envs)
            rest = f" In the others, {cause}: {explanation}" if cause else ""
            cause = "not finite"
            message = f"The rewards cannot all be compared: {fault}{rest}"
        self._records = []
        self.finding = CostFinding(
            matches=not cause,
            cause=cause,
            message=message,
            scale=line.scale,
            offset=line.offset,
            r2=line.r2,
            steps=len(steps.rewards),
            wrappers=wrappers,
        )
        if not cause:
            if self.verbose:
                print(f"Cost audit: {message}")
        elif self.strict:
            raise CostMismatchError(message)
        else:
            warnings.warn(message, CostMismatchWarning, stacklevel=2)

    def _theta(self, observations: Array) -> Array:
        if not len(observations):
            return np.zeros((0, self.policy.problem.n_theta))
        return np.asarray(self.policy.theta(observations).double().cpu().numpy())

    def _steps(
        self, theta: Array, following: Array, u: Array, rewards: Array, observations: Array
    ) -> Steps:
        options = self.policy.critic_options
        return Steps(
            theta=theta,
            following=following,
            u=u,
            rewards=rewards,
            rounding=self._rounding(observations),
            scale=options.reward_scale,
            offset=options.reward_offset,
            stage_cost=self.policy.problem.deviations.stage_cost,
        )

    def _rounding(self, observations: Array) -> Array:
        """Return by how much theta may err, (steps, n_theta); see AffineObservation."""
        digits = observations.dtype if observations.dtype.kind == "f" else np.float64
        size = np.abs(observations).astype(np.float64)
        size = size.reshape(len(size), math.prod(size.shape[1:]))
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
            what = "reward" if normalize.norm_reward else "observation"
            return f"normalized {what}", str(error)
        return "", ""
