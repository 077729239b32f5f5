"""What happens before the first step: checks, first evidence, and a handler of Ctrl-C."""

from __future__ import annotations

import random
import signal
import threading
import weakref
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EventCallback

from sb3_yann._validation import warn
from sb3_yann.audit.meaning import warn_of_box, warn_of_order, warn_of_signs
from sb3_yann.compare import COST_ROUNDING, EXCESS_ROOM, Scores, Starts
from sb3_yann.control.mpc.bound_excess import BoundNames
from sb3_yann.guard.decide import GuardSettings, Player, Unplayable, try_before_training
from sb3_yann.guard.state import Decision, Evidence, GuardState
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.rollout import Trajectories, preserve_rng, require_finite, require_repeated

OTHER_REWARD = 0.01  # of the mean cost: a reward that differs by more is another one


def first_evidence(
    player: Player, settings: GuardSettings, known: GuardState | None
) -> tuple[Evidence, ActorCheckpoint, list[Decision]]:
    """Play the MPC; accept an earlier run's policy, or the present one, if no worse.

    Return the evidence, the checkpoint to go on from, and decisions on what is refused. The hard
    starts of an earlier run stay.
    """
    candidates = [ActorCheckpoint.of(player.policy)]
    hard = list[int]()
    next_seed = settings.seeds.stop
    if known is not None:
        candidates.insert(0, known.accepted)
        next_seed = max(known.evidence.next_seed, next_seed)
        hard = sorted({*known.evidence.starts.seeds} - {*known.settings["seeds"], *settings.seeds})
    seeds = (*hard, *settings.seeds)
    mpc = _first_scores(player, settings, seeds)
    names = BoundNames.of(player.policy.problem)
    tolerance = settings.rule.tolerance(mpc.costs[len(hard) :], names)
    order = [*range(len(hard)), *(len(hard) + _regions_first(mpc.visits[len(hard) :]))]
    mpc = mpc.at(order)
    starts = Starts(tuple(seeds[i] for i in order), mpc, tolerance, len(hard))
    evidence = Evidence(player.mpc, player.mpc, starts, mpc, next_seed)
    leading = player.mpc
    decisions = list[Decision]()
    for candidate in candidates:
        if candidate.has_networks_of(leading):
            continue
        evidence, refusal = try_before_training(evidence, candidate, player, settings)
        leading = candidate if refusal is None else evidence.accepted
        if refusal is not None:
            decisions.append(refusal)
            warn(
                "What the policy had learnt is refused by the starts of this guard, "
                f"{refusal.reason}. Training begins without it. If another guard has accepted it, "
                "one with that guard's settings goes on from there."
            )
    for checkpoint in () if known is None else known.evidence.passed:
        evidence = evidence.with_passed(checkpoint)
    return evidence.with_passed(evidence.accepted), leading, decisions


def _first_scores(player: Player, settings: GuardSettings, seeds: Sequence[int]) -> Scores:
    """Return the MPC's scores; raise ValueError if the simulator cannot compare policies.

    The actor plays, not the law in float64: the MPC must be no worse than itself to the last bit.
    """
    repeated = 2  # starts from which the MPC plays twice: a simulator repeats itself
    name = settings.env
    mpc = player.episodes(player.mpc, seeds)
    require_finite(f"the guard's env {name}", seeds, mpc.costs)
    with preserve_rng():  # an env that draws from these would else repeat itself by accident
        random.random()
        np.random.random()  # noqa: NPY002
        again = player.episodes(player.mpc, seeds[:repeated])
    for seed, first, second in zip(seeds[:repeated], mpc.costs, again.costs, strict=False):
        require_repeated(f"the guard's env {name}", seed, first, second)
    first = mpc.observations[0][0]
    alike = all(np.array_equal(each[0], first) for each in mpc.observations)
    if len(seeds) > 1 and alike and np.allclose(mpc.costs, mpc.costs[0], rtol=1e-6, atol=0):
        warn(
            f"All {len(seeds)} starts of the guard's env {name} are one and the same: its reset "
            "ignores its seed. What the guard accepts is compared from this start only."
        )
    _warn_of_misreading(player, seeds, mpc)
    if settings.rule.max_input_step is not None:
        moved = [np.abs(np.diff(each, axis=0)) for each in mpc.actions if len(each) > 1]
        most = np.max([each.max(axis=0) for each in moved], axis=0) if moved else np.inf
        space: Any = player.policy.action_space
        rounding = COST_ROUNDING * (space.high - space.low)
        player.max_input_step = np.asarray(settings.rule.max_input_step * most + rounding)
    player.offset = player.policy.critic_options.reward_offset * float(np.median(mpc.lengths))
    return player.scores(mpc)


def _regions_first(visits: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return an order of starts in which the first ones come through as many regions as can be.

    The first look at a candidate is at these: what it is worth in a region shows there.
    """
    left = [*range(len(visits))]
    seen = np.zeros(visits.shape[1], dtype=bool)
    chosen = []
    while left and np.any(new := (visits[left] & ~seen).sum(axis=1)):
        chosen.append(left.pop(int(np.argmax(new))))
        seen |= visits[chosen[-1]]
    return np.array(chosen + left, dtype=np.int64)


def _warn_of_misreading(player: Player, seeds: Sequence[int], mpc: Trajectories) -> None:
    """Warn where the simulator is the model with states in another order, or a sign of inputs.

    Note whether it pays the problem's cost.
    """
    policy = player.policy
    own = mpc.mapped(player.theta, policy.inputs)
    warn_of_order(policy.problem, *own.steps())
    thetas, inputs, rewards = own.padded()
    warn_of_box(policy.problem, thetas[0])
    options = policy.critic_options
    cost = options.reward_scale * policy.problem.deviations.stage_cost(thetas[:-1], inputs)
    known = np.isfinite(rewards)  # steps that violate may cost more
    error = np.abs(cost + rewards - options.reward_offset)[known]
    player.pays_cost = not (known.any() and np.mean(error) > OTHER_REWARD * np.mean(cost[known]))
    with preserve_rng(), player.envs.acquire(1) as (env,):
        maps = {"theta": player.theta, "inputs": policy.inputs}
        player.steps += warn_of_signs(policy.problem, env, seeds, mpc, **maps)
    if player.interrupted:  # and a simulator has made of it what it can
        raise KeyboardInterrupt


def still_holds(evidence: Evidence, player: Player) -> bool:
    """Return whether five episodes are still what the evidence says: only a name is known."""
    starts = evidence.starts
    some = np.unique(np.linspace(0, len(evidence.scores.costs) - 1, 5).astype(int))
    expected = evidence.scores.at(some)
    seeds = [starts.seeds[i] for i in some]
    try:
        again = player.scores(player.episodes(evidence.accepted, seeds))
    except Unplayable:
        return False
    return (
        np.allclose(again.costs, expected.costs, rtol=1e-5, atol=1e-3 * starts.tolerance.margin)
        and again.unsafe.shape == expected.unsafe.shape
        and np.allclose(again.unsafe, expected.unsafe, atol=EXCESS_ROOM)
    )


def check_place(guard: BaseCallback) -> None:
    """Raise ValueError if a guard is not alone, or within what does not tell it of the end."""
    event = guard.parent if isinstance(guard.parent, EventCallback) else None
    callbacks = all_callbacks(guard.locals.get("callback"))
    for each in callbacks:
        if isinstance(each, EventCallback) and guard in all_callbacks(each)[1:]:
            event = each
    if event is not None:
        raise ValueError(
            f"The guard is within a callback of the class {type(event).__name__}, which does not "
            "tell it of each step and of the end: the final model might not be an accepted one. "
            "Pass the guard to learn itself; eval_freq=... makes trials rarer."
        )
    count = sum(isinstance(each, type(guard)) for each in callbacks)
    if count > 1:
        raise ValueError(
            f"{count} guards were passed to learn, expected is one: each would restore what "
            "it accepted itself. Give one guard all starts, by n_eval_episodes or a simulator of "
            "both."
        )


def warn_of_place(guard: BaseCallback, frame: FrameType | None) -> None:
    """Warn where RL Zoo would end another callback after Ctrl-C; ``frame`` is the caller's."""
    given = getattr(guard.locals.get("callback"), "callbacks", [guard])
    while frame is not None and frame.f_globals.get("__name__") != "rl_zoo3.exp_manager":
        frame = frame.f_back
    if frame is not None and guard in given[1:]:
        warn(
            f"ImprovementGuard is number {given.index(guard) + 1} of the hyperparameters' "
            "callbacks, and after Ctrl-C RL Zoo tells the first alone that training has ended: "
            "what was accepted would not be confirmed. Put the guard first."
        )


def warn_of_rare_trials(model: BaseAlgorithm, eval_freq: int) -> None:
    """Warn where a `learn` has fewer episodes than there are from one candidate to the next."""
    env: Any = model.get_env()
    if not env.has_attr("_max_episode_steps"):
        return
    steps = model._total_timesteps - model.num_timesteps
    length = max(env.get_attr("_max_episode_steps"))
    if eval_freq > max(1, count := steps // length):
        warn(
            f"eval_freq = {eval_freq} counts training episodes, not steps, and {steps} steps are "
            f"{count} of them, of {length} steps: unless they end sooner the guard tries no "
            "candidate between the first episode and the end. eval_freq=1 tries each."
        )


def all_callbacks(callback: Any) -> list[BaseCallback]:
    """Return a callback that was passed to learn, and those within it."""
    if not isinstance(callback, BaseCallback):
        return []
    within = [*getattr(callback, "callbacks", [])]
    within += [getattr(callback, name, None) for name in ("callback", "callback_on_new_best")]
    return [callback, *(found for each in within for found in all_callbacks(each))]


class InterruptHandler:
    """Ctrl-C during `learn`, of which no callback of SB3 hears.

    Calls the handler that was there; where that raises, it restores the accepted policy. Once
    another exception has ended `learn`, it only passes on.
    """

    def __init__(self, model: BaseAlgorithm, restore: Callable[[], None], frame: FrameType) -> None:
        """Take effect for a `learn` that begins, unless there can or need be no handler.

        ``restore`` is a bound method, held weakly; ``frame`` is the caller's. Handlers of runs
        that are over are passed by.
        """
        self.run = model.start_time
        self.model = weakref.ref(model)
        self.restore = weakref.WeakMethod(restore, lambda _: self.remove())
        self.before: Any = signal.getsignal(signal.SIGINT)
        while isinstance(self.before, InterruptHandler) and not self.before.is_needed(frame):
            self.before = self.before.before
        if threading.current_thread() is threading.main_thread() and callable(self.before):
            signal.signal(signal.SIGINT, self)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal."""
        try:
            self.before(number, frame)
        except BaseException:
            restore = self.restore()
            if restore is not None and self.is_needed(frame):
                restore()
            self.remove()
            raise

    def is_needed(self, frame: FrameType | None) -> bool:
        """Return whether what is running is the same `learn` as at the beginning."""
        model = self.model()
        if self.restore() is None or model is None or model.start_time != self.run:
            return False
        while frame is not None:
            if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
                return True
            frame = frame.f_back
        return False

    def remove(self) -> None:
        """Restore the handler that was there, unless somebody else's handler has come since."""
        present: object = signal.getsignal(signal.SIGINT)
        if threading.current_thread() is threading.main_thread() and present is self:
            signal.signal(signal.SIGINT, self.before)
