"""The callback that compares the first rewards of training with the problem's stage cost."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array, check_bool, check_int, check_positive
from sb3_yann.audit.causes import Cause, likely_cause, not_finite
from sb3_yann.audit.finding import (
    CostFinding,
    CostMismatchError,
    CostMismatchWarning,
    SteadyOffsetWarning,
    make_finding,
)
from sb3_yann.audit.meaning import warn_of_order
from sb3_yann.audit.offset import steady_offset
from sb3_yann.audit.sample import FEWEST, Sample
from sb3_yann.policy.observations import require_frozen
from sb3_yann.policy.policies import require_yann_policy
from sb3_yann.policy.sb3_hooks import watch_buffer
from sb3_yann.rollout import may_change_reward


class CostAudit(BaseCallback):
    """Checks that the env's reward and observation mean what the problem says, and names what not.

    Actor and critic are exact only where the reward is minus the stage cost, scaled and shifted as
    the policy's :class:`CriticOptions` say. The audit compares the first steps of every `learn`,
    and names a likely cause and wrappers of the env. Steps with ``info["violation"]``, and those
    that terminate an episode, may cost more. While the plant rests it sees nothing. Outputs that
    come to rest beside their references get a :class:`SteadyOffsetWarning` with its cure.

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
    reward_alone = False  # a guard has asked for the rest itself

    def __init__(
        self, steps: int = 100, tolerance: float = 1e-3, strict: bool = False, verbose: int = 0
    ) -> None:
        super().__init__(verbose)
        self.steps = check_int("steps", steps, FEWEST, "Fewer say nothing.")
        self.tolerance = check_positive("tolerance", tolerance, "Rounding is no mismatch.")
        self.strict = check_bool("strict", strict)
        self.finding: CostFinding | None = None

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "CostAudit")
        watch_buffer(self.model)
        self.finding, self._seen = None, 0
        self._records: list[list[dict[str, Any]]] = [[] for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        if self._seen < self.steps:
            self._record()
            if self._seen >= self.steps:
                self._judge()
        return True

    def _on_training_end(self) -> None:
        if self._seen < self.steps:
            self._judge()

    def _record(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        # The buffer holds what VecNormalize has not touched, and normalizes samples of it.
        rewards = self.locals["rewards"] if normalize is None else normalize.get_original_reward()
        # On-policy algorithms call what the env took "clipped".
        actions = self.locals.get("clipped_actions", self.locals["actions"])
        for i, records in enumerate(self._records):
            info, done = self.locals["infos"][i], bool(self.locals["dones"][i])
            following = info["terminal_observation"] if done else self.locals["new_obs"][i]
            records.append(
                {
                    "observation": np.array(self.model._last_obs[i]),  # type: ignore[index]
                    "following": np.array(following),  # copies: an env may write into its arrays
                    "action": np.array(actions[i], dtype=np.float64),
                    "reward": float(rewards[i]),
                    "step": len(records) + 1,
                    "violation": may_change_reward(info),
                    "truncated": done and bool(info.get("TimeLimit.truncated", False)),
                    "done": done,
                }
            )
        self._seen += len(self._records)

    def _judge(self) -> None:
        records = [each for of_one_env in self._records for each in of_one_env]
        if not records:  # no step was taken
            return
        lost = np.array([not _is_finite(each) for each in records], dtype=bool)
        sample = self._sample(records, lost)
        self._records = []
        enough = np.count_nonzero(sample.counted) >= FEWEST
        if not enough and not lost.any():
            return
        cause = self._of_the_vec_normalize()
        if cause is None and enough and not sample.matches_stage_cost(self.tolerance):
            cause = likely_cause(sample, self.tolerance)
        if lost.any():
            cause = not_finite(lost, records, cause)
        beside = self._resting_beside(sample) if enough else ""
        if not self.reward_alone:
            steps = sample.theta, sample.u, sample.following
            warn_of_order(self.policy.problem, *steps, stacklevel=2)
        self.finding = make_finding(sample, cause, self.training_env, beside)
        if beside:
            warnings.warn(beside, SteadyOffsetWarning, stacklevel=2)
        if cause is not None:
            if self.strict:
                raise CostMismatchError(self.finding.message)
            warnings.warn(self.finding.message, CostMismatchWarning, stacklevel=2)
        elif self.verbose:
            print(f"Cost audit: {self.finding.message}")

    def _resting_beside(self, sample: Sample) -> str:
        """Return how far outputs rest beside their references, empty where nobody asks."""
        return "" if self.reward_alone else steady_offset(self.policy.problem, sample)

    def _sample(self, records: list[dict[str, Any]], lost: NDArray[np.bool_]) -> Sample:
        """Return the records without the lost ones, after which another episode begins."""

        def column(name: str) -> Any:
            return np.array([each[name] for each in records])[~lost]

        def theta(name: str) -> Array:
            return np.asarray(self.policy.theta(column(name)).double().cpu().numpy())

        every_env = np.repeat(np.arange(len(self._records)), [len(each) for each in self._records])
        ended = np.array([each["done"] for each in records], dtype=bool) | lost
        env = every_env[~lost]
        first = np.r_[True, np.diff(env) != 0][: len(env)]
        begins = first | np.r_[True, ended[:-1]][~lost]
        problem, options = self.policy.problem, self.policy.critic_options
        observations = column("observation").reshape(len(env), records[0]["observation"].size)
        terminated = column("done") & ~column("truncated")
        return Sample(
            theta=theta("observation"),
            following=theta("following"),
            u=self.policy.inputs(column("action")),
            rewards=column("reward"),
            counted=~(column("violation") | terminated),
            terminated=terminated,
            episode=np.cumsum(begins),
            begins=begins,
            first=first,
            blank=~np.any(observations, axis=1),
            rounding=self._rounding(observations),
            scale=options.reward_scale,
            offset=options.reward_offset,
            stage_cost=problem.deviations.stage_cost,
            step=problem.deviations.predict,
            theta_ss=problem.theta_ss,
            gamma=self.model.gamma,
        )

    def _rounding(self, observations: Array) -> Array:
        """Return by how much theta may err, (steps, n_theta); see AffineObservation."""
        digits = observations.dtype if observations.dtype.kind == "f" else np.float64
        size = np.abs(observations).astype(np.float64)
        if (seen := self.policy.to_theta) is not None:
            # What a normalization hides of its size is in the offset.
            size = size @ np.abs(seen.matrix).T + np.abs(seen.offset)
        return np.asarray(size * float(np.finfo(digits).eps))

    def _of_the_vec_normalize(self) -> Cause | None:
        """Return what has been set since the policy was built and let it pass."""
        if (normalize := self.model.get_vec_normalize_env()) is None:
            return None
        try:
            require_frozen(normalize)
        except ValueError as error:
            what = "reward" if normalize.norm_reward else "observation"
            return Cause(f"normalized {what}", str(error))
        return None


def _is_finite(record: dict[str, Any]) -> bool:
    return all(np.all(np.isfinite(record[each])) for each in ("observation", "following", "reward"))
