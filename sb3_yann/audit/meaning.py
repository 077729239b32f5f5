"""What an env means: the order and units of its states, the signs of its inputs, its reward."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import permutations, product
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_yann._validation import Array, Mask, warn
from sb3_yann.control import LinearMPC
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.mpc.misreading import misread_states
from sb3_yann.control.wrapper_stack import SHOW_THETA, require_theta_order
from sb3_yann.rollout import Trajectories
from sb3_yann.wrappers.theta import EstimateState, below

SIGN_STARTS = 5
"""Starts from which each input is pushed; it must act against the model from all of them."""
FAR = 3.5  # times as far or as little as the model says: a nonlinear plant alone varies more
SIGN_STEPS = 10  # steps for which it is pushed where outputs are read


class CostMismatchWarning(UserWarning):
    """The env's reward is not minus the stage cost of the problem."""


class CostMismatchError(RuntimeError):
    """The same as an error, where `CostAudit` is strict.

    It is no ValueError: RL Zoo silently prunes a trial with one.
    """


def warn_of_order(problem: LinearMPC, theta: Array, u: Array, following: Array) -> None:
    """Warn where the model predicts the steps of an env in another reading of its states alone."""
    if words := misread_states(problem, theta, u, following):
        warn(words)


def warn_of_box(problem: LinearMPC, theta: Array) -> None:
    """Warn of a state that reads beyond theta's box where episodes begin (starts, n_theta)."""
    own = problem.deviations
    names = labels_of(problem.model)[0]
    share = np.mean((theta < own.theta_min) | (theta > own.theta_max), axis=0)[: len(names)]
    i = int(np.argmax(share))
    if share[i] > 0.5:  # share of the starts beyond a box that is no chance
        warn(
            f"{names[i]} reads beyond theta's box, for which the MPC is made, where "
            f"{share[i]:.0%} of the episodes begin: does the env show it in another unit, or in "
            "another order? Else widen theta_min and theta_max."
        )


def warn_of_signs(
    problem: LinearMPC,
    env: gym.Env[Any, Any],
    seeds: Sequence[int],
    played: Trajectories,
    *,
    theta: Callable[[Array], Array] = np.asarray,
    inputs: Callable[[Array], Array] = np.asarray,
) -> int:
    """Warn where an input moves the states against the model or far otherwise, in the first step.

    Two steps from one start differ by that input alone: neither noise that the seed repeats, nor
    what is not linear in the states, gets in. The steps that this takes are returned. Estimates go
    at first where their model goes: of an estimator the readings count, and inputs are held for
    `SIGN_STEPS`, since outputs may answer late. ``played`` are the MPC's episodes from the seeds;
    ``theta`` and ``inputs`` map what the env shows and takes to the problem's.
    """
    model = problem.model
    names = labels_of(model)[1]
    states = problem.layout.state
    shown = np.concatenate([theta(each)[:, states] for each in played.observations])
    estimating = below(env, EstimateState)
    C = np.eye(model.n_states) if estimating is None else estimating.observer.C
    steps = 1 if estimating is None else SIGN_STEPS
    spread = np.std(shown[np.isfinite(shown).all(axis=1)] @ C.T, axis=0)
    weight = np.divide(1, spread, out=np.zeros_like(spread), where=spread > 0)
    response = np.cumsum([np.linalg.matrix_power(model.A, k) @ model.B for k in range(steps)], 0)
    starts = [i for i in range(len(seeds)) if len(played.actions[i])][:SIGN_STARTS]
    taken = 0

    def hold(i: int, action: Array) -> Array:
        nonlocal taken
        env.reset(seed=seeds[i])
        found: list[Any] = []
        for _ in range(steps):
            taken += 1
            after = theta(env.step(action.copy())[0][None])[0, states]
            found.append(after if estimating is None else estimating.readings)
        return np.array(found)

    unmoved: dict[int, Array] = {}
    modelled = np.array([response[..., j] @ C.T for j in range(len(names))])
    answers = np.zeros_like(modelled)
    warnings = list[str]()
    for j, name in enumerate(names):
        gains = []
        for i in starts:
            action = played.actions[i][0]
            try:
                if i not in unmoved:
                    first = theta(played.observations[i][1:2])[:, states]
                    unmoved[i] = first if estimating is None else hold(i, action)
                pushed = _push(env, action, j, 0.5)
                change = hold(i, pushed) - unmoved[i]
                if not np.any(np.nan_to_num(weight * change)):  # perhaps within a dead band
                    pushed = _push(env, action, j, 1.0)
                    change = hold(i, pushed) - unmoved[i]
            except Exception:  # of a brittle simulator: what it says under the MPC counts
                break
            by = np.diff(inputs(np.array([action, pushed])), axis=0)[0, j]
            answers[j] += change / by
            effect = weight * change
            expected = weight * modelled[j] * by
            expected[~np.isfinite(effect)] = 0  # readings that come now and then
            effect = np.nan_to_num(effect)
            size = float(np.sum(expected**2))
            # An effect below 1e-3 of the states' standard deviation may be rounding.
            if size > 0 and max(np.linalg.norm(effect), 0.01 * size**0.5) > 1e-3:
                gains.append(float(np.sum(effect * expected)) / size)
        if starts and len(gains) == len(starts):
            when = "a step" if steps == 1 else f"{steps} steps"
            warnings += _misled(name, gains, when, model.step_length)
    swapped = _swapped(modelled, answers, spread, estimating is not None)
    for words in [swapped] if swapped else warnings:
        warn(words)
    return taken


def _misled(name: str, gains: Sequence[float], when: str, dt: str) -> Iterator[str]:
    """Yield what an input does otherwise than the model says, if that holds from all starts."""
    found = f"{np.median(gains):.2g} times as far in {when}, from {len(gains)} start"
    found += "s" * (len(gains) > 1)
    if max(gains) < 0:
        yield (
            f"{name} moves the env against the sign of the model's B: {found}. The MPC steers "
            "the wrong way. Look at the sign and the order of the actions, and at B."
        )
    elif min(gains) > FAR or (0 <= min(gains) and max(gains) < 1 / FAR):
        yield (
            f"{name} moves the env otherwise than the model's B says: {found}. Is a step of "
            f"the env the model's dt, {dt}, and the input in the same unit? Does it act, and "
            "without a delay? Else identify the model anew."
        )


def _swapped(modelled: Array, answers: Array, spread: Array, outputs: bool) -> str:
    """Return in which other order alone what is shown answers pushes as the model says.

    Pushes and answers have the shape (m, steps, q). States may have their order: it is looked at by
    `warn_of_order`.
    """

    def likeness(shown: Sequence[int], taken: Sequence[int]) -> float:
        both = np.stack([answers[:, :, shown], modelled[[*taken]]]) / units
        both = both.reshape(2, len(modelled), -1)
        sizes = np.maximum(np.linalg.norm(both, axis=-1).prod(axis=0), 1e-300)
        return float(np.min(both.prod(axis=0).sum(axis=-1) / sizes))

    m, _, q = modelled.shape
    units = np.linalg.norm(modelled, axis=(0, 1)) if outputs else spread
    units = np.where(units > 0, units, np.inf)
    shows = permutations(range(q)) if outputs else [tuple(range(q))]
    orders = [*product(shows, permutations(range(m)))] if max(q * outputs, m) <= 4 else []
    found = max(orders, key=lambda each: likeness(*each), default=None)
    # The cosines of answers to pushes and the model's: these are others, or in another order.
    if found is None or not likeness(range(q), range(m)) < 0.7 < 0.95 < likeness(*found):
        return ""
    return (
        f"The env seems to show the model's {'outputs' if outputs else 'states'} in the order "
        f"{np.argsort(found[0]).tolist()}, and to take its inputs in the order {[*found[1]]}: so "
        "it answers pushes as the model says, and as it is it does not. Sort what it shows, or "
        "takes, as the model has it."
    )


def _push(env: gym.Env[Any, Any], action: Array, j: int, share: float) -> Array:
    """Return an action whose entry j goes a share of the way to the bound that is farther away."""
    space: Any = env.action_space
    width = float(space.high[j]) - float(space.low[j])
    far = width if width < 1e30 else 1e3
    ends = np.clip([space.low[j], space.high[j]], action[j] - far, action[j] + far)
    pushed = np.array(action, dtype=space.dtype)
    pushed[j] += share * (max(ends, key=lambda end: abs(end - action[j])) - action[j])
    return pushed


def warn_of_own_reward(problem: LinearMPC, played: Trajectories) -> None:
    """Warn where rewards are not minus the stage cost, times a constant and up to one.

    The latter may be each episode's own: it ranks no controllers. The cost may be that of the state
    before the step or after it. Rewards that are all zero are none.
    """
    thetas, inputs, rewards = played.padded()
    costs = [problem.deviations.stage_cost(at, inputs) for at in (thetas[:-1], thetas[1:])]
    known: Mask = np.asarray(np.all(np.isfinite([rewards, *costs]), axis=0), dtype=np.bool_)
    if np.count_nonzero(known) < 10 or not np.any(rewards[known]):  # steps that must be seen
        return
    share = max(explained(-cost, rewards, known) for cost in costs)
    if share < 0.95:  # explained of the rewards' variance: another cost
        warn(
            f"The env has a reward of its own, and it is ignored: the MPC's stage cost explains "
            f"{100 * share:.0f} % of it over {np.count_nonzero(known)} steps of the MPC. Weights "
            "may differ, or the rest that distances count from, x_ss and u_ss of the model. What "
            "counts here is the MPC's stage cost. If the reward is what you want, state it in Q "
            "and R of the MPC, or learn under an ImprovementGuard or a Commissioning, which go by "
            "the reward; else wrap the env in sb3_yann.wrappers.StageCost(env, mpc).",
            CostMismatchWarning,
        )


def explained(gain: Array, rewards: Array, known: Mask) -> float:
    """Return the share of the rewards' variance within episodes that a gain explains, 0 to 1.

    It is 1 where the gain does not vary, which says nothing, and 0 where rewards fall as it rises.
    """
    count = np.maximum(known.sum(axis=0), 1)  # of each episode, a column
    x, y = (
        (each - np.where(known, each, 0.0).sum(axis=0) / count)[known] for each in (gain, rewards)
    )
    size = np.sqrt(np.sum(x**2) * np.sum(y**2))
    if np.abs(x).max() <= 1e-9 * np.abs(gain[known]).max():
        return 1.0
    return max(float(x @ y / size), 0.0) ** 2 if size > 0 else 0.0


def require_spaces(problem: LinearMPC, env: gym.Env[Any, Any]) -> None:
    """Raise unless an env shows theta and takes the inputs."""
    shape = env.observation_space.shape
    actions = env.action_space.shape
    if shape != (problem.n_theta,) or actions != (problem.model.n_inputs,):
        raise ValueError(
            f"The env shows {shape} and takes {actions}; theta of the MPC has {problem.n_theta} "
            f"entries {problem.labels()}, and there are {problem.model.n_inputs} inputs. "
            f"{SHOW_THETA} with_extra(mpc, low, high) has signals that the model ignores."
        )
    require_theta_order(env, problem)


def require_theta_shown(problem: LinearMPC, theta: Array, starts: Array) -> None:
    """Raise where theta (steps, n_theta), in deviations, was made of what are deviations already.

    So it is where the states of ``starts`` (episodes, n_theta) alone say it: a law that takes one
    number for another drives the plant off. Nor may references and measured disturbances lie beyond
    their box in nearly all steps.
    """
    shown = problem.units.to_plant(theta)
    begins = problem.units.to_plant(starts)
    n = problem.model.n_states
    begins[:, n:] = problem.theta_ss[n:]  # what may be read later
    for rows in (shown, begins):
        if words := problem.shown_as_deviation(rows):
            raise ValueError(f"The env is not that of the MPC. {words}")
    room = 1e-3 * problem.theta_half
    most = 0.9  # share of the rows that must speak for it
    beyond = (shown < problem.theta_min - room) | (shown > problem.theta_max + room)
    for i in np.flatnonzero(np.mean(beyond, axis=0) >= most):
        if n <= i < problem.layout.disturbance.stop:
            raise ValueError(
                f"{problem.labels()[i]} is {shown[0, i]:.6g}, and the MPC was solved for "
                f"{problem.theta_min[i]:.6g} to {problem.theta_max[i]:.6g}: give the wrapper that "
                "shows it the bounds of the MPC."
            )
