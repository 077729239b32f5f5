"""Closed loops of a controller and a plant, from seeded starts: the one loop that steps envs."""

from __future__ import annotations

import itertools
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import ArrayLike, NDArray

from sb3_yann._progress import bar
from sb3_yann._validation import Array, add_note, check_int, check_type, half_widths, warn
from sb3_yann.compare import less_safe, unsafe_columns
from sb3_yann.control import LinearModel, LinearMPC, OnlineLaw, PiecewiseAffine
from sb3_yann.control.mpc.bound_excess import BoundExcess, costs_of
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import EnvPool, Source, require_like, vector_env_of
from sb3_yann.units import same_bounds

Rows = NDArray[np.intp]
Controller = Callable[[int, NDArray[Any], Rows], NDArray[Any]]
"""From the step, observations (r, n) and the numbers (r,) of the episodes that show them to actions
(r, m). At step 0 it is asked for all episodes."""
LONG_EPISODE = 100_000  # steps of an episode after which a warning is given
MAX_EPISODE_STEPS = 1_000_000
"""Steps of an episode after which it counts as endless, which is an error."""


@dataclass(frozen=True)
class Trajectories:
    """Closed-loop episodes, in the order of their seeds.

    Attributes
    ----------
    costs : ndarray, shape (episodes,)
        Minus the sum of the rewards; with a problem, the sum of its stage costs, with the penalty
        of soft bounds.
    violations : ndarray of int, shape (episodes,)
        Steps whose ``info["violation"]`` is true.
    observations : tuple of ndarray, shapes (steps + 1, n)
    actions : tuple of ndarray, shapes (steps, m)
    terminated : ndarray of bool, shape (episodes,)
        Whether the env ended the episode itself, other than by a time limit, or with
        ``info["is_success"]``.
    truncated : ndarray of bool, shape (episodes,)
        Whether only a time limit ended it.
    succeeded : ndarray of bool, shape (episodes,)
        Whether its last ``info["is_success"]`` was true.
    rewards : tuple of ndarray, shapes (steps,)
    own_rewards : tuple of ndarray, shapes (steps,)
        The same; NaN at a violation, or an end, which may have changed the reward.
    excess : BoundExcess, optional
        By how much each episode exceeds the bounds of the problem, where one was given.
    penalty : ndarray, shape (episodes,)
        What soft bounds cost, of `StageCost` and twins: it is in no reward.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> episodes = evaluate(lambda observation: [0.0], "CSTR-v0", seeds=[0, 1])
    >>> [len(actions) for actions in episodes.actions]
    [400, 400]
    """

    costs: Array
    violations: NDArray[np.int64]
    observations: tuple[Array, ...]
    actions: tuple[Array, ...]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    succeeded: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    rewards: tuple[Array, ...] = ()
    own_rewards: tuple[Array, ...] = ()
    excess: BoundExcess | None = None
    penalty: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Number of steps of each episode (episodes,)."""
        return np.array([len(each) for each in self.actions], dtype=np.int64)

    @property
    def pairs(self) -> list[tuple[Array, Array]]:
        """Observations (steps + 1, n) and actions (steps, m) of each episode."""
        return [*zip(self.observations, self.actions, strict=True)]

    def mapped(
        self, theta: Callable[[Array], Array], inputs: Callable[[Array], Array]
    ) -> Trajectories:
        """Return the same episodes with other observations and actions."""
        shown = tuple(map(theta, self.observations))
        return replace(self, observations=shown, actions=tuple(map(inputs, self.actions)))

    def padded(self) -> tuple[Array, Array, Array]:
        """Return observations (T + 1, k, n), actions (T, k, m) and own rewards (T, k).

        After its end an episode stays where it is, and its rewards are NaN.
        """
        rewards = np.full((int(self.lengths.max()), len(self.actions)), np.nan)
        for i, each in enumerate(self.own_rewards):
            rewards[: len(each), i] = each
        return padded(self.observations), padded(self.actions), rewards

    def steps(self) -> tuple[Array, Array, Array]:
        """Return observations, actions and following observations of all steps, in time."""
        states, actions, _ = self.padded()
        taken = np.arange(len(actions))[:, None] < self.lengths
        return states[:-1][taken], actions[taken], states[1:][taken]

    def unsafe(self, far: ArrayLike = 0) -> Array:
        """Return what :func:`~sb3_yann.compare.less_safe` compares of each; the excess is known.

        ``far`` (episodes,) counts steps in which an input moves too far.
        """
        assert self.excess is not None
        finite = np.array([np.all(np.isfinite(each)) for each in self.observations], dtype=bool)
        lost = ~(np.isfinite(self.costs) & finite)
        ended = np.where(self.succeeded, -1, self.terminated)
        return unsafe_columns(self.violations, ended, lost, self.excess, far, self.lengths)

    def no_worse(self, others: Trajectories) -> NDArray[np.bool_]:
        """Return which episodes are as long as others, and break no bound by more."""
        return np.asarray(~less_safe(self.unsafe(), others.unsafe()).any(axis=1))


def padded(parts: Sequence[Array]) -> Array:
    """Return arrays of rows side by side, (T, k, ...); after its end each stays where it is."""
    rows = np.arange(max(map(len, parts)))
    return np.stack([each[np.minimum(rows, len(each) - 1)] for each in parts], axis=1)


def evaluate(
    policy: Any,
    env: Source | EnvPool,
    seeds: Iterable[int],
    starts: Sequence[ArrayLike] | None = None,
) -> Trajectories:
    """Return one whole episode for each seed, under the policy without any noise.

    Parameters
    ----------
    policy : model or callable
        Something with ``predict(observation, deterministic=True)``, or a function from an
        observation to an action, such as the explicit law. A model below a VecNormalize is shown
        what that makes of the env's observations.
    env : gymnasium.Env, str or callable
        Must end its episodes within a million steps. A given env runs them one after the other.
        A named one, or a function that makes one, is made for each seed: the episodes run side by
        side, and the policy sees them as one batch. An :class:`EnvPool` keeps them for next time.
    seeds : iterable of int
        ``env.reset(seed=seed)`` starts each episode; the rest of it must follow from that.
    starts : sequence of array_like, optional
        The state of each start, ``env.reset(options={"state": ...})``, for envs that have one.

    Raises
    ------
    RuntimeError
        If an episode does not end.

    Examples
    --------
    >>> import gymnasium
    >>> law = gymnasium.make("CSTR-v0").observation_space.problem.explicit()
    >>> bool(evaluate(law, "CSTR-v0", seeds=[0]).costs[0] > 0)
    True
    """
    check = partial(_require_fit, policy)
    return rollout(as_controller(policy), env, seeds, starts, check=check)


def rollout(
    controller: Controller,
    plant: Source | EnvPool,
    seeds: Iterable[int],
    starts: Sequence[ArrayLike] | None = None,
    *,
    problem: LinearMPC | None = None,
    check: Callable[[Any], None] = lambda env: None,
) -> Trajectories:
    """Return one whole episode for each seed; for ``seeds`` and ``starts`` see :func:`evaluate`.

    A registered env whose copies step as one array is stepped so. The plant shows theta of a
    ``problem``, and takes its inputs, both in deviations: then ``costs`` are its stage costs, and
    ``excess`` is known. Inputs reach the plant in the type of its action space. ``check`` is called
    with the first env, and raises if it does not fit.
    """
    seeds = as_seeds(seeds)
    pool = plant if isinstance(plant, EnvPool) else EnvPool(plant)
    source = pool.source
    if isinstance(source, str) and (vector_env := vector_env_of(source, len(seeds))) is not None:
        with closing(vector_env):
            check(vector_env)
            options = None if starts is None else {"state": starts}
            played = _play(controller, _Copies([vector_env], seeds, options))
    else:
        given = [None] * len(seeds) if starts is None else [{"state": each} for each in starts]
        resets = [*zip(seeds, given, strict=True)]
        most = min(pool.most or len(seeds), len(seeds))
        with pool.acquire(most) as envs:
            for each in envs[:1]:
                check(each)
            if len({id(each.unwrapped) for each in envs}) < len(envs):
                raise ValueError(
                    "The function that makes envs returned the same one twice. Make a new one each "
                    "time, since episodes run side by side, or pass the env itself."
                )
            firsts: Iterable[int] = range(0, len(seeds), max(most, 1))
            if len(seeds) > most:  # played one lot after the other
                firsts = bar("episodes", firsts)
            lots = []
            for i in firsts:
                plants = _Envs(envs, resets[i : i + most], problem, pool.each)
                lots.append(_play(of_episode(controller, i), plants))
        if pool is not plant:
            pool.close()
        played = joined(lots)
    if problem is None:
        return played
    thetas, inputs, _ = played.padded()
    taken = np.arange(len(inputs))[:, None] < played.lengths
    costs, excess = costs_of(problem, thetas, inputs, taken)
    return replace(played, costs=costs, excess=excess)


def as_controller(policy: Any) -> Controller:
    """Return a model, a law, or a function from an observation to an action as a controller."""
    if isinstance(policy, LinearMPC):
        raise TypeError(
            "policy is a LinearMPC, which is a problem: pass its law, mpc.explicit() or mpc.law()."
        )
    if hasattr(policy, "predict"):
        predict = policy.predict
        normalize = getattr(policy, "get_vec_normalize_env", lambda: None)()
        if normalize is None:
            return lambda t, observations, rows: predict(observations, deterministic=True)[0]
        if normalize.observation_space.shape != policy.observation_space.shape:
            raise ValueError(
                f"VecNormalize shows {normalize.observation_space.shape}, but the model sees "
                f"{policy.observation_space.shape}. Make VecNormalize the last wrapper, outside "
                "VecFrameStack."
            )
        shown = normalize.normalize_obs  # to a model, of an env below it
        return lambda t, observations, rows: predict(shown(observations), deterministic=True)[0]
    if not callable(policy):
        raise TypeError(f"policy = {policy!r} must have a predict method or be callable.")
    act = policy
    if isinstance(policy, PiecewiseAffine | OnlineLaw) and policy.units.shifted:
        act = policy.plant_input
    if isinstance(policy, PiecewiseAffine):
        return lambda t, observations, rows: act(observations)
    return lambda t, observations, rows: np.array([act(each) for each in observations])


def of_episode(controller: Controller, number: int) -> Controller:
    """Return the controller of the episodes from one on, which are played without the others."""
    return lambda t, observations, rows: controller(t, observations, rows + number)


class _Step(NamedTuple):
    """What one step of some episodes brings, (r,) each; a violation may have changed the reward."""

    observations: NDArray[Any]
    rewards: Array
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    violated: NDArray[np.bool_]
    succeeded: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    penalty: Array


@dataclass
class _Envs:
    """One env for each episode; those that are over wait for the others."""

    envs: Sequence[gym.Env[Any, Any]]
    resets: Sequence[tuple[int, dict[str, Any] | None]]
    problem: LinearMPC | None
    each: Callable[..., Iterable[Any]]
    steps: int = 0  # of the episode, the one that is under way included
    steps_all = False

    def reset(self) -> NDArray[Any]:
        """Return the first observations (k, n)."""
        starts = enumerate(self.resets)  # the last lot may be smaller
        shown = (self._asked(i, "reset", seed=s, options=o)[0] for i, (s, o) in starts)
        # A copy of each: an env may write its next observation into the same array.
        return np.stack([*map(np.array, shown)])

    def step(self, actions: Any, rows: Rows) -> _Step:
        """Step the envs ``rows`` (r,) with actions (r, m)."""
        self.steps += 1
        observations, *others = zip(*self.each(self._one, rows, actions), strict=True)
        return _Step(np.stack(observations), *(np.array(each) for each in others))

    def _one(self, i: int, action: Any) -> tuple[Any, ...]:
        """Step one env, and return what is in a `_Step` of it."""
        if self.problem is not None:
            action = action.astype(self.envs[i].action_space.dtype)
        observation, reward, terminated, truncated, info = self._asked(i, "step", action)
        reported = bool(info.get("violation", False)), bool(info.get("is_success", False))
        paid = float(info["penalty"]) if "excess" in info else 0.0  # as StageCost tells it
        flags = bool(terminated), bool(truncated), *reported, may_change_reward(info)
        return np.array(observation), as_reward(reward), *flags, paid

    def _asked(self, i: int, name: str, *given: Any, **named: Any) -> Any:
        """Call a method of an env; an error says in which episode, and where in it."""
        try:
            answer = getattr(self.envs[i], name)(*given, **named)
            expected = ANSWERS[name]
            if not (
                isinstance(answer, tuple | list)
                and len(answer) == len(expected.split(", "))
                and isinstance(answer[-1], Mapping)
            ):
                kinds = type(answer).__name__
                if isinstance(answer, tuple | list):
                    kinds = ", ".join(type(each).__name__ for each in answer)
                raise TypeError(f"{name} returned ({kinds}), expected ({expected}), info a dict.")
            return answer
        except Exception as error:
            where = f"step {self.steps}" if self.steps else "the reset"
            add_note(error, f"in {where} of the episode from the seed {self.resets[i][0]}")
            raise


ANSWERS = {"reset": "observation, info", "step": "observation, reward, terminated, truncated, info"}
"""What gymnasium asks of an env."""


@dataclass
class _Copies:
    """Copies in one env that step as one array; those that are over begin another, unused."""

    envs: Sequence[VectorEnv[Any, Any, Any]]
    seeds: Any
    options: dict[str, Any] | None
    steps_all = True

    def reset(self) -> NDArray[Any]:
        """Return the first observations (k, n)."""
        return np.array(self.envs[0].reset(seed=self.seeds, options=self.options)[0])

    def step(self, actions: Any, rows: Rows) -> _Step:
        """Step all copies with actions (k, m)."""
        observations, rewards, *ends, info = self.envs[0].step(actions)
        none = np.zeros(len(rows))
        reported = [info.get(name, none) for name in ("violation", "is_success", "violation")]
        earned = np.array(rewards, dtype=np.float64)
        flags = (np.array(each, dtype=bool) for each in (*ends, *reported))
        return _Step._make([np.array(observations), earned, *flags, none])


def _play(controller: Controller, plant: _Envs | _Copies) -> Trajectories:
    """Play one episode in each env of a plant, side by side."""
    shown = plant.reset()
    n = len(shown)
    rows: Rows = np.arange(n)
    running = np.ones(n, dtype=bool)
    inputs = list[Array]()
    steps = list[_Step]()
    states = [np.array(shown, dtype=np.float64)]
    passed = bar(f"{n} episode{'s' * (n > 1)}: steps", total=limit_of(plant.envs[0]))
    while running.any():
        actions = np.asarray(controller(len(inputs), shown, rows))
        inputs.append(_scattered(actions, rows, n).astype(np.float64))  # an env may write into them
        step = _Step(*(_scattered(each, rows, n) for each in plant.step(actions, rows)))
        states.append(step.observations.astype(np.float64))
        steps.append(step)
        passed.update()
        running &= ~(step.terminated | step.truncated)
        rows = rows if plant.steps_all else np.flatnonzero(running)
        shown = step.observations[rows]
        if running.any():
            _watch_length(plant.envs[rows[0] if len(plant.envs) > 1 else 0], len(inputs))
    passed.close()
    _, rewards, terminated, truncated, violated, succeeded, changed, penalty = map(
        np.array, zip(*steps, strict=True)
    )
    last = np.argmax(terminated | truncated, axis=0)
    taken = np.arange(len(steps))[:, None] <= last
    at_end = last, np.arange(n)
    own = np.where(changed | terminated, np.nan, rewards)

    def parts(values: Any, more: int = 1) -> tuple[Array, ...]:
        together = np.array(values, dtype=np.float64)
        return tuple(together[: k + more, i].copy() for i, k in enumerate(last))

    return Trajectories(
        costs=0.0 - np.cumsum(np.where(taken, rewards, 0.0), axis=0)[-1],  # in the order of time
        violations=np.sum(violated & taken, axis=0),
        observations=parts(states, 2),
        actions=parts(inputs),
        terminated=(terminated & ~succeeded)[at_end],
        truncated=(truncated & ~terminated)[at_end],
        succeeded=succeeded[at_end],
        rewards=parts(rewards),
        own_rewards=parts(own),
        penalty=np.sum(np.where(taken, penalty, 0.0), axis=0),
    )


def _scattered(values: NDArray[Any], rows: Rows, n: int) -> NDArray[Any]:
    """Return values (r, ...) of some episodes as those of all, (n, ...)."""
    found = np.zeros((n, *values.shape[1:]), dtype=values.dtype)
    found[rows] = values
    return found


def limit_of(env: Any) -> int | None:
    """Return after how many steps an env ends an episode, None where that is not known."""
    if isinstance(env, gym.Env) and env.has_wrapper_attr("_max_episode_steps"):
        return int(env.get_wrapper_attr("_max_episode_steps"))
    return getattr(env, "max_episode_steps", None)


def joined(parts: Sequence[Trajectories]) -> Trajectories:
    """Return the episodes of all parts as one."""

    def together(name: str) -> Any:
        values = [getattr(each, name) for each in parts]
        if isinstance(values[0], np.ndarray):
            return np.concatenate(values)
        if isinstance(values[0], BoundExcess):
            return BoundExcess(*map(np.concatenate, zip(*values, strict=True)))
        return None if values[0] is None else tuple(itertools.chain(*values))

    if not parts:
        return Trajectories(np.zeros(0), np.zeros(0, np.int64), (), (), np.zeros(0, dtype=bool))
    return Trajectories(**{each.name: together(each.name) for each in fields(Trajectories)})


def _watch_length(env: Any, steps: int) -> None:
    """Warn of an episode that is long, and raise RuntimeError where it seems to have no end."""
    if steps not in (LONG_EPISODE, MAX_EPISODE_STEPS):
        return
    message = (
        f"An episode of {env} has not ended after {steps} steps, all of which are kept in memory. "
        "Give it a limit: max_episode_steps when it is registered, or gymnasium.wrappers.TimeLimit."
    )
    if steps == MAX_EPISODE_STEPS:
        raise RuntimeError(message)
    warn(message)


def as_seeds(seeds: Iterable[int]) -> list[int]:
    """Return the seeds of episodes, whole numbers of at least 0."""
    check_type("seeds", seeds, Iterable, "a seed for each episode, e.g. range(20)")
    return [check_int("seeds", each, 0) for each in seeds]


def require_finite(env: str, seeds: Sequence[int], costs: Array) -> None:
    """Raise ValueError where an MPC's episode from a seed costs no finite number."""
    for i in np.flatnonzero(~np.isfinite(costs))[:1]:
        raise ValueError(
            f"The MPC's episode of {env} from the seed {seeds[i]} costs {costs[i]:g}: what the env "
            "shows and pays must be finite numbers, for policies are compared by their costs."
        )


def require_repeated(env: str, seed: int, cost: float, again: float) -> None:
    """Raise ValueError unless an env repeats an MPC's episode: its cost, where that is finite."""
    if np.isfinite(cost) and not np.isclose(cost, again, rtol=1e-6, atol=0):
        raise ValueError(
            f"The MPC played two episodes of {env} from the seed {seed}, at costs of {cost:.6g} "
            f"and {again:.6g}: {env} does not repeat it. Episodes are compared in pairs: all that "
            "is random in the env must come from self.np_random, and no wrapper may remember "
            "earlier episodes, as NormalizeReward does. If it draws from numpy's global "
            "generator, wrap it in sb3_yann.wrappers.SeededGlobals."
        )


def as_reward(value: Any) -> float:
    """Return a reward as a number, NaN where it is none."""
    try:
        number = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return np.nan
    return float(number.ravel()[0]) if number.size == 1 else np.nan


def may_change_reward(info: Mapping[str, Any]) -> bool:
    """Tell whether a step reports a violation for which its reward may be another one.

    An env whose every step is one would be compared nowhere: `StageCost` says what it added.
    """
    return bool(info.get("violation", False)) and info.get("violation_cost") != 0


@contextmanager
def preserve_rng() -> Iterator[None]:
    """Restore the global random states that older envs, and modules of torch, draw from."""
    python = random.getstate()
    legacy = np.random.get_state()  # noqa: NPY002
    torch: Any = sys.modules.get("torch")
    cpu = None if torch is None else torch.get_rng_state()
    cuda = torch.cuda.get_rng_state_all() if torch and torch.cuda.is_initialized() else []
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
        if cpu is not None:
            torch.set_rng_state(cpu)
        if cuda:
            torch.cuda.set_rng_state_all(cuda)


def as_played(name: str, value: Trajectories) -> Trajectories:
    """Return ``value`` if it is Trajectories, else raise TypeError."""
    return check_type(name, value, Trajectories, "the Trajectories that evaluate returns")


def _require_fit(policy: Any, env: Any) -> None:
    """Raise where a model's spaces are not the env's, or a law does not see the state.

    Or where the env takes deviations, and the law's plant has an operating point, or inputs that
    do not hold the law's.
    """
    is_model = hasattr(policy, "observation_space")
    if is_model and isinstance(getattr(policy, "action_space", None), gym.spaces.Box):
        require_like(env, policy, "env", "the model")
    acts = getattr(policy, "policy", policy)  # a model's
    owner = getattr(acts, "__self__", acts)  # of a method, such as law.plant_input
    is_law = isinstance(owner, PiecewiseAffine | OnlineLaw)
    if isinstance(env, gym.Env) and (is_law or hasattr(owner, "observation_given")):
        require_state_shown(env, getattr(owner, "observation_given", False))
    space = getattr(env, "single_action_space", env.action_space)
    model = getattr(policy, "model", None)
    if not isinstance(policy, PiecewiseAffine | OnlineLaw) or not isinstance(model, LinearModel):
        return
    if not isinstance(space, gym.spaces.Box):
        return
    takes = f"The env takes inputs from {space.low.tolist()} to {space.high.tolist()}"
    own = (policy.u_min, policy.u_max)  # in deviations
    half = half_widths(*own)
    if np.any(model.u_ss) and same_bounds((space.low, space.high), own, half):
        raise ValueError(
            f"{takes}, which are deviations, and the law is of a plant with u_ss = "
            f"{model.u_ss.tolist()}. Leave x_ss and u_ss out of the model, or take the env in "
            "plant units."
        )
    low, high = (each + model.u_ss for each in own)
    beyond = (space.low > low + 0.01 * half) & np.isfinite(low)
    beyond |= (space.high < high - 0.01 * half) & np.isfinite(high)
    beyond |= (space.high - space.low > 20 * half) & np.isfinite([space.low, space.high]).all(0)
    if np.any(beyond):
        warn(
            f"{takes}, and the law's are from {low.tolist()} to {high.tolist()}: if the env is in "
            "other units, wrap it in gymnasium.wrappers.RescaleAction(env, mpc.u_min, mpc.u_max)."
        )
