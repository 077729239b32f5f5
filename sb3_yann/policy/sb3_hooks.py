"""What a policy does around Stable-Baselines3 and PyTorch."""

from __future__ import annotations

import math
import sys
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_yann._validation import NonFiniteWarning, warn
from sb3_yann.control.mpc.bound_excess import Bounds
from sb3_yann.control.mpc.misreading import STEPS_PER_STATE, misread_states


def algorithm_under_construction(lr_schedule: Any) -> BaseAlgorithm | None:
    """Return the algorithm that is building a policy, None where nobody is.

    SB3 hands a policy its spaces and its learning rate, but not the discount, which the critic
    needs to be exact; so the whole call stack is asked, whatever decorators and factories are on
    the way. The algorithm is the one whose `_setup_model` is running, or that holds the learning
    rate. Called from a policy's `__init__` only.
    """
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        held = frame.f_locals
        building = held.get("self") if frame.f_code.co_name == "_setup_model" else None
        for each in held.values():
            if isinstance(each, BaseAlgorithm):
                if each is building or getattr(each, "lr_schedule", None) is lr_schedule:
                    return each
        frame = frame.f_back
    return None


def multiply_learning_rate(optimizer: th.optim.Optimizer, factor: float) -> None:
    """Make one step use ``factor`` times the rate that SB3 keeps setting."""
    for group in optimizer.param_groups:
        group["scheduled_lr"] = group["lr"]
        group["lr"] = factor * group["lr"]


def restore_learning_rate(optimizer: th.optim.Optimizer, *_: Any) -> None:
    """Undo :func:`multiply_learning_rate` after the step."""
    for group in optimizer.param_groups:
        group["lr"] = group.pop("scheduled_lr")


@contextmanager
def single_precision() -> Iterator[None]:
    """Make networks of float32 within, as SB3's replay buffer holds actions and rewards."""
    default = th.get_default_dtype()
    th.set_default_dtype(th.float32)
    try:
        yield
    finally:
        th.set_default_dtype(default)


class KeepsPrecision:
    """A module that moves to other devices, and refuses other types of numbers."""

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> Any:
        for dtype in (th.float32, th.float64):
            if (wanted := fn(th.zeros(1, dtype=dtype)).dtype) != dtype:
                raise TypeError(
                    f"{type(self).__name__} cannot become {wanted}: the law is computed in float64 "
                    "and the networks in float32, to which the compiled loops and SB3's replay "
                    "buffer keep. Leave double(), float(), half() and to(dtype) out; to(device) "
                    "is fine."
                )
        return super()._apply(fn, recurse)  # type: ignore[misc]


class FiniteRows:
    """Stands in for the ``add`` of a replay buffer, and leaves out rows that are not finite.

    One row holds a transition of each env; all of it is left out. The row before counts as cut
    off, so that no n-step return bridges the gap. SB3 samples right after the first row: until
    there is another, a row with reward NaN keeps the place, and the optimizers take no step.
    """

    def __init__(self, buffer: ReplayBuffer) -> None:
        self.rows = self.left_out = 0  # those that came, and those that were left out
        self.keeps_place = False
        self.named: dict[tuple[str, int, int], int] = {}
        self.buffer = weakref.ref(buffer)  # a cycle would keep a large buffer after its time

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "buffer": self.buffer()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({**state, "buffer": weakref.ref(state["buffer"])})

    def __call__(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any
    ) -> None:
        """Add a row, if it is finite."""
        buffer = self.buffer()
        assert buffer is not None  # whoever calls has it
        self.rows += 1
        if self.keeps_place:
            buffer.reset()
            self.keeps_place = False
        parts = (obs, next_obs, action, reward)
        total = sum(float(np.vdot(part, part)) for part in parts)
        sure = 1e36  # sums of squares up to this are of entries that are finite in float32
        if total < sure or not (found := _not_finite(buffer, parts)):  # nor is NaN below it
            type(buffer).add(buffer, obs, next_obs, action, reward, done, infos)
            return
        self.left_out += 1
        if buffer.size() > 0:
            last = buffer.pos - 1
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], buffer.dones[last] == 0)
        else:
            s, after, u = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in parts[:3])
            nothing = np.full(np.shape(reward), np.nan)
            type(buffer).add(buffer, s, after, u, nothing, done, infos)
            self.keeps_place = True
        again = 100  # steps after which the same thing is named again
        new = [key for key in found if self.rows - self.named.get(key, -again) >= again]
        self.named.update(dict.fromkeys(new, self.rows))
        if new:
            what = ", ".join(f"{name}[{j}] of env {i} is {found[name, i, j]}" for name, i, j in new)
            warn(
                f"Step {self.rows}: {what}. The transition is not learnt from"
                f"{' (nor are those of the other envs)' if buffer.n_envs > 1 else ''}; "
                f"{self.left_out} left out so far. Mend the env or the sensor.",
                NonFiniteWarning,
            )


def _not_finite(buffer: ReplayBuffer, parts: tuple[Any, ...]) -> dict[tuple[str, int, int], Any]:
    """Return what is not finite as the buffer would keep it, by name, env and entry."""
    found = {}
    names = ("observation", "observation", "action", "reward")
    for name, part in zip(names, parts, strict=True):
        given = np.asarray(part).reshape(buffer.n_envs, -1)
        with np.errstate(over="ignore"):
            kept = given.astype(getattr(buffer, f"{name}s").dtype)
        for i, j in np.argwhere(~np.isfinite(kept)).tolist():
            found[name, i, j] = given[i, j]
    return found


def warn_of_random_actions(algorithm: Any) -> None:
    """Warn where a `learn` begins with actions that SB3 draws from the whole range."""
    count = getattr(algorithm, "learning_starts", 0) - getattr(algorithm, "num_timesteps", 0)
    if count > 0 and algorithm.num_timesteps == algorithm._num_timesteps_at_start:
        warn(
            f"The first {count} actions of this learn are random, evenly over the whole range, "
            "limits or not. For the policy's own from the first step on, pass learn(..., "
            f"callback=NoActionNoise()), or learning_starts=0 to the {type(algorithm).__name__}."
        )


def warn_of_first_steps(policy: Any, algorithm: Any) -> None:
    """Warn, once, of states in other units or order, and of rewards that are not the MPC's cost.

    A guard and a `CostAudit` look themselves.
    """
    buffer = getattr(algorithm, "replay_buffer", None)
    if policy.states_checked or not isinstance(buffer, ReplayBuffer):
        return
    # 200: steps of a learn after which what the env shows is compared with the model
    count = max(200, STEPS_PER_STATE * policy.problem.model.n_states)
    rows = -(-count // buffer.n_envs)
    if buffer.size() < rows or buffer.optimize_memory_usage:
        return
    policy.states_checked = True
    if policy.guarded:
        return
    normalize = algorithm.get_vec_normalize_env()  # the buffer holds what it has not touched
    thetas = []
    for each in (buffer.observations[:rows], buffer.next_observations[:rows]):
        seen = each if normalize is None else normalize.normalize_obs(each)
        theta = policy.theta(seen.reshape(-1, *buffer.obs_shape))
        thetas.append(theta.double().cpu().numpy())
    u = policy.inputs(policy.unscale_action(buffer.actions[:rows].reshape(len(thetas[0]), -1)))
    if words := misread_states(policy.problem, thetas[0], u, thetas[1]):
        warn(words)
        return
    rewards = buffer.rewards[:rows].reshape(-1).astype(float)
    rewards = rewards if normalize is None else normalize.normalize_reward(rewards)
    options = policy.critic_options
    cost = policy.problem.deviations.stage_cost(thetas[0], u)
    expected = options.reward_offset - options.reward_scale * cost
    # Violations and ends of episodes may cost more; of the others those that cost most, and the
    # median: the wrappers of an env may know of more.
    known = np.isfinite(rewards) & (buffer.dones[:rows].reshape(-1) == 0)
    known &= ~np.any(Bounds.of(policy.problem).beyond(thetas[1]), axis=1)
    if not known.any():
        return
    most = known & (cost > np.mean(cost[known]))
    if not most.any():
        return
    wrong = np.median(np.abs(rewards - expected)[most])
    typical = options.reward_scale * np.median(cost[most])
    if wrong > 0.25 * typical:  # a reward that differs by a quarter is another cost
        warn(
            f"Rewards are not the MPC's cost: of the first {len(rewards)} steps half of the most "
            f"costly {np.count_nonzero(most)} differ by {wrong:.3g} or more from what the critic, "
            f"which starts as the MPC's value, counts with, where a step costs {typical:.3g}. "
            "learn(..., callback=CostAudit()) names in what; StageCost(env, mpc) makes rewards of "
            "the cost."
        )


def watch_buffer(model: BaseAlgorithm) -> None:
    """Let the model's replay buffer leave out what is not finite, unless something stands in."""
    buffer = getattr(model, "replay_buffer", None)
    # With optimize_memory_usage a row is the next one's past too: only its batches are refused.
    if isinstance(buffer, ReplayBuffer) and not buffer.optimize_memory_usage:
        vars(buffer).setdefault("add", FiniteRows(buffer))


def finite_gradient(optimizer: th.optim.Optimizer) -> bool:
    """Return whether the gradient and its square, which Adam keeps, are finite in float32."""
    total = 0.0
    for parameter in _weights(optimizer):
        if (gradient := parameter.grad) is not None:
            flat = (gradient._values() if gradient.is_sparse else gradient).reshape(-1)
            total += float(th.dot(flat, flat))
    return math.isfinite(total)


def _weights(optimizer: th.optim.Optimizer) -> list[th.Tensor]:
    return [each for group in optimizer.param_groups for each in group["params"]]


def warn_of_refused_step(
    name: str, optimizer: th.optim.Optimizer, refused: int, algorithm: Any
) -> None:
    """Name a step that is not taken: the first, the tenth, the hundredth, ..."""
    if str(refused).strip("0") != "1":
        return
    advice = "Look for rewards or values that are huge, and bound or scale them."
    paid = getattr(getattr(algorithm, "rollout_buffer", None), "rewards", np.zeros(1))
    if not np.isfinite(paid).all():
        advice = "The env has paid rewards that are not finite: mend it."
    if not all(bool(each.isfinite().all()) for each in _weights(optimizer)):
        advice = f"The weights of the {name} are not finite any more: load an earlier save."
    warn(
        f"The gradient of the {name} is not finite, or too large for float32: this step is not "
        f"taken ({refused} so far). {advice}",
        NonFiniteWarning,
    )


def what_is_not_finite(lost: NDArray[np.bool_], names: Sequence[str] = ()) -> str:
    """Say what an actor did without: entries of observations (batch, n), or its networks."""
    if entries := np.flatnonzero(lost.any(0)).tolist():
        called = f" ({', '.join(names[i] for i in entries)})" if names else ""
        where = f"The observation is not finite in entries {entries}{called}"
        return f"{where}: the law acts, at the operating point in what depends on them."
    return "The actor's networks put out what is not finite: the law acts alone."
