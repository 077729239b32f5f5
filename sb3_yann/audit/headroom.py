"""What a nearly optimal controller would gain over the MPC, and of what kind that is."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from rich.progress import track

from sb3_yann._validation import Array, as_flag, as_whole
from sb3_yann.audit.slopes import slopes_by_model, slopes_by_simulator, slopes_by_twin
from sb3_yann.audit.trajectory import Play, Trajectory, optimize
from sb3_yann.control import LinearMPC, offset_free
from sb3_yann.evaluation.episodes import LONGEST, Source, one_env
from sb3_yann.twin.plant_twin import PlantTwin

LITTLE = 0.005
"""A gain below this, relative to the MPC's cost, is not worth the trouble."""
MOST = 0.5
"""Share of the gain from which on one part of it decides what to do."""
Maker = Callable[[], Callable[[int, Array], Array]]
VERDICTS = "do not bother", "add ObserveDisturbance first", "re-identify", "learn"


@dataclass(frozen=True)
class Headroom:
    """What there is to gain over an MPC, as :func:`headroom` has found it.

    Attributes
    ----------
    mpc_costs, observer_costs, reidentified_costs, best_costs : ndarray, shape (starts,)
        Costs of the MPC; with a disturbance observer (:func:`offset_free`); with a model that is
        re-identified from these episodes (the MPC's own where those are worse on average); of the
        best trajectory found.
    offset, model_error, nonlinearity : float
        Parts of the gain, relative to the MPC's mean cost: what the observer gains, which removes
        the offset of a plant that is not its model; what the re-identified model gains beyond
        that; the rest.
    verdict : str
        What to do: one of "do not bother", "add ObserveDisturbance first", "re-identify", "learn".
    source : str
        Where it was found.

    Examples
    --------
    >>> costs = np.array([10.0, 20.0])
    >>> found = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    >>> round(found.total, 4)
    0.0333
    """

    mpc_costs: Array
    observer_costs: Array
    reidentified_costs: Array
    best_costs: Array
    offset: float
    model_error: float
    nonlinearity: float
    verdict: str
    source: str

    @property
    def total(self) -> float:
        """The whole gain, relative to the MPC's mean cost."""
        return _gain(self.mpc_costs, self.best_costs)

    def report(self) -> str:
        """Return the figures, and what to do, in words."""
        mpc, best = self.mpc_costs.mean(), self.best_costs.mean()
        each = 100 * (self.best_costs - self.mpc_costs) / np.maximum(np.abs(self.mpc_costs), 1e-300)
        advice = dict(
            zip(
                VERDICTS,
                (
                    "the MPC is nearly optimal here.",
                    "that brings most of it: mpc, observer = offset_free(mpc), and env = "
                    "ObserveDisturbance(env, observer, low, high).",
                    "a linear model of the plant as it is brings most of it: see "
                    "LinearModel.from_data, PlantTwin.reidentified, improve(model, twin).",
                    "most of it is beyond a linear model: improve(model, twin), or DDPG under an "
                    "ImprovementGuard.",
                ),
                strict=True,
            )
        )
        parts = (
            ("offset, which a disturbance observer removes", self.offset),
            ("model error beyond that", self.model_error),
            ("nonlinearity and constraints", self.nonlinearity),
        )
        lines = [
            f"The MPC costs {mpc:.5g} from {len(self.mpc_costs)} starts of {self.source}; "
            f"the best trajectories found {best:.5g}: {-100 * self.total:+.2f} % "
            f"(from {each.min():+.2f} to {each.max():+.2f} % by start).",
            *(f"  {name}: {-100 * part:+.2f} %" for name, part in parts),
            f"An MPC with a re-identified model: "
            f"{-100 * _gain(self.mpc_costs, self.reidentified_costs):+.2f} %.",
            f"Verdict: {self.verdict}; {advice[self.verdict]}",
        ]
        return "\n".join(lines)

    __str__ = report


def headroom(
    mpc: LinearMPC,
    env_or_twin: Source | PlantTwin,
    *,
    n_starts: int = 30,
    seed: int = 0,
    progress_bar: bool = False,
) -> Headroom:
    """Return what a nearly optimal controller would gain over an MPC, and why.

    From each start a trajectory is optimized without preview: by differential dynamic programming
    from the MPC's own, and from that of an MPC with a re-identified model. Every trajectory has
    been played, and violates no more than the MPC does, so the gain can be had; more may be there
    to be found. A part of it needs to know the plant, and none of a controller's robustness is in
    it: take it for a bound of what learning can bring.

    Parameters
    ----------
    mpc : LinearMPC
        Its stage cost is what counts.
    env_or_twin : gymnasium.Env, str, callable or PlantTwin
        A simulator that shows theta of the MPC and takes its inputs, and plays the same episode
        again from the same seed and inputs; or a twin of the MPC's plant.
    n_starts : int, default 30
        Starts, from ``seed`` on.
    seed : int, default 0
        Of the first start.
    progress_bar : bool, default False
        Whether to show how many starts are done.

    Raises
    ------
    TypeError, ValueError
        If the env shows something else than theta, or does not repeat an episode; if a twin cannot
        be trusted.

    Examples
    --------
    >>> import gymnasium as gym
    >>> from sb3_yann import headroom
    >>> mpc = gym.make("CSTR-v0").observation_space.problem
    >>> found = headroom(mpc, "CSTR-v0", n_starts=2)
    >>> 0.01 < found.total < 0.05, found.verdict in ("learn", "do not bother")
    (True, False)
    """
    if not isinstance(mpc, LinearMPC):
        raise TypeError(f"mpc = {mpc!r} must be a LinearMPC.")
    as_whole("n_starts", n_starts, 2)
    as_whole("seed", seed, 0)
    as_flag("progress_bar", progress_bar)
    if isinstance(env_or_twin, PlantTwin):
        return _of_twin(mpc, env_or_twin, range(seed, seed + n_starts), progress_bar)
    with one_env(env_or_twin) as env:
        _require_theta(mpc, env)
        source = getattr(env.spec, "id", type(env.unwrapped).__name__)
        return _of_env(mpc, env, range(seed, seed + n_starts), progress_bar, source)


def _of_twin(mpc: LinearMPC, twin: PlantTwin, seeds: range, progress_bar: bool) -> Headroom:
    twin.require_trust()
    if twin.problem.n_theta != mpc.n_theta or not np.array_equal(twin.problem.u_min, mpc.u_min):
        raise ValueError(
            "The twin is that of another MPC's plant: fit it with PlantTwin.fit(mpc, episodes)."
        )
    with closing(twin.env(0)) as env:
        return _of_env(mpc, env, seeds, progress_bar, "the twin", twin)


def _of_env(
    mpc: LinearMPC,
    env: gym.Env[Any, Any],
    seeds: range,
    progress_bar: bool,
    source: str,
    twin: PlantTwin | None = None,
) -> Headroom:
    """Return the headroom in an env.

    Parameters
    ----------
    mpc, env, seeds, progress_bar
        As in :func:`headroom`.
    source : str
        The env's name.
    twin : PlantTwin, optional
        Its slopes are used; by default those of one that is fitted to the MPC's episodes.
    """
    plays = [_player(mpc, env, each) for each in seeds]
    first = [play(_by_law(mpc)) for play in plays]
    _require_repeatable(plays[0], first[0], mpc)
    if twin is None:
        twin = PlantTwin.fit(mpc, [(each.thetas, each.inputs) for each in first], n_members=1)
    slopes = slopes_by_twin(twin) if twin.trusted else slopes_by_simulator(mpc, env, first[0])
    slopes = slopes or slopes_by_model(mpc)
    other = twin.reidentified() if twin.trusted else mpc
    again = [play(_by_law(other)) for play in plays] if other is not mpc else first
    maker = _by_observer(mpc, first)
    observed = first if maker is None else [play(maker()) for play in plays]
    best = []
    rounds = [*zip(plays, first, again, observed, strict=True)]
    for play, ours, *others in track(rounds, "Headroom", disable=not progress_bar):
        begin = [ours, *(each for each in others if each.is_better_than(ours))]
        ends = [optimize(mpc, play, slopes, each) for each in begin]
        best.append(min(ends, key=lambda each: each.cost))
    return _split(first, observed, again, best, source)


def _split(
    mpc: list[Trajectory],
    observed: list[Trajectory],
    again: list[Trajectory],
    best: list[Trajectory],
    source: str,
) -> Headroom:
    """Return the figures.

    Parameters
    ----------
    mpc, observed, again, best : list of Trajectory
        From each start: the MPC's, with an observer, with a re-identified model, and optimized.
    source : str
        Where they were played.
    """
    costs, least = (np.array([each.cost for each in runs]) for runs in (mpc, best))
    with_observer, others = (_no_worse(runs, mpc) for runs in (observed, again))
    total, offset, known = (_gain(costs, each) for each in (least, with_observer, others))
    offset, known = min(offset, total), min(known, total)
    verdict = VERDICTS[3]
    if total < LITTLE:
        verdict = VERDICTS[0]
    elif max(offset, known) >= MOST * total:
        verdict = VERDICTS[1] if offset >= known else VERDICTS[2]
    parts = offset, max(0.0, known - offset), total - max(offset, known)
    return Headroom(costs, with_observer, others, least, *parts, verdict, source)


def _no_worse(runs: list[Trajectory], mpc: list[Trajectory]) -> Array:
    """Return the costs of some runs, or the MPC's where those are not worse on average."""
    ours, theirs = (np.array([each.cost for each in some]) for some in (mpc, runs))
    safe = sum(each.broken for each in runs) <= sum(each.broken for each in mpc)
    whole = all(len(a.inputs) >= len(b.inputs) for a, b in zip(runs, mpc, strict=True))
    return theirs if safe and whole and theirs.mean() <= ours.mean() else ours


def _gain(before: Array, after: Array) -> float:
    return float((before.mean() - after.mean()) / (abs(before.mean()) or 1.0))


def _by_law(mpc: LinearMPC) -> Callable[[int, Array], Array]:
    law = mpc.law()
    return lambda _, theta: law(theta)


def _by_observer(mpc: LinearMPC, runs: list[Trajectory]) -> Maker | None:
    """Return what makes an offset-free controller for an episode; None where there can be none."""
    if mpc.layout.n_disturbances:  # it has one, or measures
        return None
    beyond = np.max([_beyond_model(mpc, run) for run in runs], axis=0)
    unit = mpc.theta_half[mpc.layout.state]
    found, observer = offset_free(mpc, np.maximum(2 * beyond, 1e-6 * unit))
    law, n, last = found.online(), mpc.model.n_states, found.layout.n_previous

    def make() -> Callable[[int, Array], Array]:
        own = copy.deepcopy(observer)
        inputs: list[Array] = [np.zeros(mpc.model.n_inputs)]

        def act(t: int, theta: Array) -> Array:
            x_hat, d_hat = own.reset(theta[:n]) if t == 0 else own.update(theta[:n], inputs[-1])
            d_hat = np.clip(d_hat, found.disturbances.d_min, found.disturbances.d_max)
            rest = theta[n : len(theta) - last]
            inputs.append(law(np.concatenate([x_hat, rest, d_hat, theta[len(theta) - last :]])))
            return inputs[-1]

        return act

    return make


def _beyond_model(mpc: LinearMPC, run: Trajectory) -> Array:
    """Return how far each state (n,) has moved from what the model predicts, at most."""
    A, B = mpc.prediction
    predicted = run.thetas[:-1] @ A.T + run.inputs @ B.T
    return np.asarray(np.abs((run.thetas[1:] - predicted)[:, mpc.layout.state]).max(axis=0))


def _player(mpc: LinearMPC, env: gym.Env[Any, Any], seed: int) -> Play:
    """Return what plays an episode from a seed."""

    def play(act: Callable[[int, Array], Array]) -> Trajectory:
        theta, _ = env.reset(seed=seed)
        thetas: list[Array] = [np.asarray(theta, float)]
        inputs: list[Array] = []
        broken, over = 0, False
        while not over:
            if len(inputs) == LONGEST:
                raise ValueError(f"The episode from seed {seed} does not end: set a time limit.")
            u = np.asarray(act(len(inputs), thetas[-1]), env.action_space.dtype)
            theta, _, terminated, truncated, info = env.step(u)
            inputs.append(np.asarray(u, float))
            thetas.append(np.asarray(theta, float))
            broken, over = broken + bool(info.get("violation", False)), terminated or truncated
        states, taken = np.array(thetas), np.array(inputs)
        return Trajectory(states, taken, mpc.stage_cost(states[:-1], taken), broken)

    return play


def _require_theta(mpc: LinearMPC, env: gym.Env[Any, Any]) -> None:
    shape, actions = env.observation_space.shape, env.action_space.shape
    if shape != (mpc.n_theta,) or actions != (mpc.model.n_inputs,):
        raise ValueError(
            f"The env shows {shape} and takes {actions}; theta of the MPC has {mpc.n_theta} "
            f"entries {mpc.layout.names}, and there are {mpc.model.n_inputs} inputs. Wrap the env "
            "so that it shows theta: see Deviations, PastInputs and ObserveDisturbance in "
            "sb3_yann.wrappers."
        )


def _require_repeatable(play: Play, first: Trajectory, mpc: LinearMPC) -> None:
    again = play(_by_law(mpc))
    if not np.allclose(again.cost, first.cost, rtol=1e-6, atol=0):
        raise ValueError(
            f"The MPC's episode from the first seed cost {first.cost:.6g}, then {again.cost:.6g}: "
            "the env does not repeat it. All that is random must come from reset(seed=...)."
        )
