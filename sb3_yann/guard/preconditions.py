"""What must hold before a guard can compare policies."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback

from sb3_yann.control import LinearMPC
from sb3_yann.evaluation.episodes import Episodes, one_env
from sb3_yann.guard.episodes import ROUNDING, Outcome, outcome_of, play_episodes
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.session import GuardSession
from sb3_yann.policy.policies import YannPolicy, require_problem_of_twin


def check_simulator(session: GuardSession, name: str) -> None:
    """Raise ValueError if the simulator is the training env, or an env of another shape."""
    training_env = session.model.get_env()
    assert training_env is not None
    training = [env.unwrapped for env in getattr(training_env, "envs", [])]
    with preserve_rng(), one_env(session.simulator) as env:
        if any(env.unwrapped is each for each in training):
            raise ValueError(
                "The guard's env is the training env, whose episodes its own would interrupt. "
                "Give it another one, e.g. its id."
            )
        ours, theirs = env.observation_space.shape, training_env.observation_space.shape
        if ours != theirs or env.action_space != training_env.action_space:
            raise ValueError(
                f"The guard's env {name} has observations of shape {ours} and {env.action_space}, "
                f"the training env {theirs} and {training_env.action_space}. "
                "Give the guard a simulator of this plant."
            )


def check_not_nested(guard: BaseCallback) -> None:
    """Raise ValueError if a callback is within one that does not tell it of the end."""
    event = guard.parent if isinstance(guard.parent, EventCallback) else None
    event = event or _event_above(guard, guard.locals.get("callback"))
    if event is not None:
        raise ValueError(
            f"The guard is within a callback of the class {type(event).__name__}, which does not "
            "tell it of each step and of the end: the final model might not be an accepted one. "
            "Pass the guard to learn itself; eval_every=... makes trials rarer."
        )


def check_alone(guard: BaseCallback) -> None:
    """Raise ValueError if another guard is among what was passed to learn."""
    found = passed_to_learn(guard, type(guard))
    if len(found) > 1:
        raise ValueError(
            f"{len(found)} guards were passed to learn, expected is one: each would restore what "
            "it accepted itself. Give one guard all starts, by n_starts or a simulator of both."
        )


def passed_to_learn(guard: BaseCallback, kind: type[BaseCallback]) -> list[BaseCallback]:
    """Return the callbacks of a kind beside a guard, those within others too."""
    waiting, found = [guard.locals.get("callback")], []
    while waiting:
        each = waiting.pop()
        waiting += [*getattr(each, "callbacks", [])]
        waiting += [getattr(each, name, None) for name in ("callback", "callback_on_new_best")]
        waiting = [other for other in waiting if isinstance(other, BaseCallback)]
        found += [each] if isinstance(each, kind) else []
    return found


def _event_above(
    guard: BaseCallback, callback: BaseCallback | None, above: EventCallback | None = None
) -> EventCallback | None:
    """Return the EventCallback that the guard is under, among what was passed to learn."""
    if callback is guard:
        return above
    children: list[BaseCallback | None] = [*getattr(callback, "callbacks", [])]
    if isinstance(callback, EventCallback):
        above = callback
        children += [callback.callback, getattr(callback, "callback_on_new_best", None)]
    found = (_event_above(guard, each, above) for each in children if each is not None)
    return next((each for each in found if each is not None), None)


def first_episodes(
    session: GuardSession, name: str, seeds: Sequence[int], largest_step: float | None
) -> Outcome:
    """Return what comes of the MPC; raise ValueError if the simulator cannot compare policies.

    The actor plays, not the law in float64: the MPC must be no worse than itself to the last bit.

    Parameters
    ----------
    session : GuardSession
        Its state is told how far inputs may move.
    name : str
        The env's, for messages.
    seeds : sequence of int
        Of the starts.
    largest_step : float or None
        That in multiples of the MPC's largest step, None for any.
    """
    mpc = play_episodes(session, session.mpc, seeds)
    for seed, cost in zip(seeds, mpc.costs, strict=True):
        if not np.isfinite(cost):
            raise ValueError(
                f"The MPC's episode of the guard's env {name} from the seed {seed} costs {cost:g}. "
                "Policies are compared by their costs: rewards must be finite numbers."
            )
    again = play_episodes(session, session.mpc, seeds)
    for seed, first, second in zip(seeds, mpc.costs, again.costs, strict=True):
        if not np.isclose(first, second, rtol=1e-6, atol=0):
            raise ValueError(
                f"The MPC played two episodes of the guard's env {name} from the seed {seed}, "
                f"at costs of {first:g} and {second:g}. Episodes are compared in pairs: all that "
                "is random in the env must come from self.np_random."
            )
    if len(seeds) > 1 and _all_alike(mpc):
        warnings.warn(
            f"All {len(seeds)} starts of the guard's env {name} are one and the same: its reset "
            "ignores its seed. What the guard accepts is compared from this start only.",
            stacklevel=2,
        )
    if largest_step is not None:
        moved = [np.abs(np.diff(each, axis=0)) for each in mpc.actions if len(each) > 1]
        most = np.max([each.max(axis=0) for each in moved], axis=0) if moved else np.inf
        inputs: Any = session.policy.action_space
        room = ROUNDING * (inputs.high - inputs.low)
        session.state.input_step = np.asarray(largest_step * most + room)
    return outcome_of(session, mpc)


def _all_alike(episodes: Episodes) -> bool:
    first = episodes.observations[0][0]
    starts = all(np.array_equal(each[0], first) for each in episodes.observations)
    return starts and bool(np.allclose(episodes.costs, episodes.costs[0], rtol=1e-6, atol=0))


def check_twin(policy: YannPolicy, problem: LinearMPC) -> None:
    """Raise ValueError unless a twin shows what the policy observes, theta of the same problem."""
    require_problem_of_twin(policy, problem)
    if policy.observation is not None:
        raise ValueError(
            "The twin shows theta, but the model's policy makes theta of its observations. Guard "
            "it in a simulator that shows those, or improve it with improve(model, twin)."
        )
