"""What a nearly optimal controller would gain over the MPC, and of what kind that is."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike
from rich.progress import track

from sb3_yann._validation import Array, check_bool, check_int
from sb3_yann.audit.closed_loops import (
    PAUSE,
    Excited,
    Observing,
    Planning,
    of_law,
    of_model,
    require_repeated,
)
from sb3_yann.audit.gains import LITTLE, UNKNOWN, WORTH, Headroom, gain, verdict_of
from sb3_yann.audit.in_deviations import in_deviations, require_theta_shown
from sb3_yann.audit.input_signs import warn_of_signs
from sb3_yann.audit.observed_order import warn_of_order
from sb3_yann.audit.offset import remaining_offset
from sb3_yann.audit.own_reward import below_set_points, warn_of_own_reward
from sb3_yann.audit.plants import (
    Access,
    Plant,
    TwinPlant,
    lack_of_fit,
    simulated,
    simulated_dynamics,
)
from sb3_yann.audit.task import WEIGHT, Task
from sb3_yann.control import DisturbanceObserver, LinearMPC, OnlineLawWarning, offset_free
from sb3_yann.control.mpc.offset_free import SHARE
from sb3_yann.rollout import Source, Trajectories, maker, rollout
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode, as_episodes
from sb3_yann.twin.observers import observer_of
from sb3_yann.twin.plant_twin import PlantTwin
from sb3_yann.twin.reidentification import reidentified
from sb3_yann.twin.row_layout import RowLayout

LACKING = 0.5
"""A twin is poor where neighboring steps share so much of its errors: that is no noise."""
SURE = 2.0
"""Standard errors that a gain on a random plant must exceed."""


def headroom(
    mpc: LinearMPC,
    env_or_twin: Source | PlantTwin,
    *,
    n_starts: int = 30,
    seed: int = 0,
    progress_bar: bool = False,
    set_state: Callable[[Any, Array], object] | None = None,
    get_state: Callable[[Any], ArrayLike] | None = None,
) -> Headroom:
    """Return what a nearly optimal controller would gain over an MPC, and why.

    From the same starts are played: the MPC; the MPC with a disturbance observer; an MPC whose
    model is re-identified from the MPC's episodes; and plans, optimized by differential dynamic
    programming, on which feedback keeps the plant. Plans begin their search at the MPC's runs, with
    inputs on their bounds for a while, and at the cheapest runs of unconstrained laws with other
    weights. They know neither noise nor the references to come: a
    change makes a new plan. All costs are those of episodes that were played, so the gain can be
    had; more may be there to be found. A part of it needs to know the plant, and none of a
    controller's robustness is in it: take it for a bound of what learning can bring.

    Plans are tried in the env where it can be put into a state and repeats its steps, as
    :meth:`LinearModel.from_env` needs it too; else in a twin of its episodes. A plant that repeats
    its steps has the best controller of each start. A random one has the best on average, for the
    best of each start would be luck.

    Parameters
    ----------
    mpc : LinearMPC
        Its stage cost is what counts. A :class:`CostMismatchWarning` says where the env's own
        reward is another one.
    env_or_twin : gymnasium.Env, str, callable or PlantTwin
        A simulator that shows theta of the MPC and takes its inputs, in plant units where the MPC's
        model has an operating point. It plays the same episode again from the same
        seed and inputs, and is copied. Or a twin of the MPC's plant, each of
        whose members has its share of the starts.
    n_starts : int, default 30
        Starts, from ``seed`` on.
    seed : int, default 0
        Of the first start.
    progress_bar : bool, default False
        Whether to show how much is done.
    set_state, get_state : callable, optional
        ``set_state(env, x)`` and ``get_state(env)`` of a simulator, as :meth:`LinearModel.from_env`
        takes them.

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
    check_int("n_starts", n_starts, 2)
    check_int("seed", seed, 0)
    check_bool("progress_bar", progress_bar)
    access = set_state, get_state
    for name, given in zip(("set_state", "get_state"), access, strict=True):
        if given is not None and not callable(given):
            raise TypeError(f"{name} = {given!r} must be a function.")
    if isinstance(env_or_twin, PlantTwin) and access != (None, None):
        raise ValueError("set_state and get_state are those of an env: a twin needs neither.")
    search = _Search(mpc, env_or_twin, range(seed, seed + n_starts), access)
    stages = (search.play_mpc, search.observe, search.reidentify, search.plan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OnlineLawWarning)
        for stage in track(stages, "Headroom", disable=not progress_bar):
            stage()
    return search.found()


class _Search:
    """What is played, one controller after the other.

    Parameters
    ----------
    mpc : LinearMPC
    given : gymnasium.Env, str, callable or PlantTwin
    seeds : range
    access : tuple of two callables, or None
        ``set_state`` and ``get_state``.
    """

    def __init__(
        self, mpc: LinearMPC, given: Source | PlantTwin, seeds: range, access: Access
    ) -> None:
        self.mpc, self.seeds, self.access = mpc, seeds, access
        self.twin, self.random, self.doubted = None, False, False
        self.lost: float | None = None
        self.d_max: Array | None = None
        self.make: Callable[[], gym.Env[Any, Any]]
        if isinstance(given, PlantTwin):
            given.require_trust()
            other = given.problem
            if other.layout != mpc.layout or not np.array_equal(
                other.deviations.u_min, mpc.deviations.u_min
            ):
                raise ValueError(
                    "The twin is that of another MPC's plant: fit it with PlantTwin.fit(mpc, "
                    "episodes)."
                )
            self.twin, self.make, self.source = given, given.env, "the twin"
        else:
            self.make = maker(given)
            self.source = _name(mpc, self.make)
            self.make = in_deviations(self.make, mpc)

    def play_mpc(self) -> None:
        """Play the MPC, and see that the env repeats an episode."""
        self.base = base = rollout(of_law(self.mpc), self.make, self.seeds, problem=self.mpc)
        self.others: dict[str, Trajectories] = {}
        if not np.all(np.isfinite(base.costs)):
            i = int(np.flatnonzero(~np.isfinite(base.costs))[0])
            raise ValueError(
                f"The MPC's episode from the seed {self.seeds[i]} costs {base.costs[i]}: what the "
                "env shows must be finite numbers."
            )
        require_theta_shown(self.mpc, base.steps()[0])
        require_repeated(self.mpc, self.make, self.seeds[0], base.costs[0])
        if self.twin is None:
            warn_of_order(self.mpc, *base.steps(), stacklevel=4)
            with closing(self.make()) as env:
                unaware = below_set_points(env)
                warn_of_signs(self.mpc, env, self.seeds, base, stacklevel=4)
            if not unaware:
                warn_of_own_reward(self.mpc, base, stacklevel=4)

    def observe(self) -> None:
        """Play the same MPC with an observer, unless it has one or measures disturbances."""
        mpc = self.mpc
        if mpc.layout.n_disturbances:
            return
        thetas, inputs, following = self.base.steps()
        beyond = np.abs(following - mpc.deviations.predict(thetas, inputs)).max(axis=0)[
            mpc.layout.state
        ]
        unit = mpc.theta_half[mpc.layout.state]
        try:
            largest = np.maximum(2 * beyond, 1e-6 * unit)
            pair = offset_free(mpc, largest)
        except ValueError:  # a disturbance that no input can hold
            return
        if np.any(largest > SHARE * unit):  # the default would cut off what was found here
            self.d_max = np.maximum(largest, SHARE * unit)
        self.others["observer"] = rollout(Observing(mpc, *pair), self.make, self.seeds, problem=mpc)

    def reidentify(self) -> None:
        """Play the MPC with a model that its own episodes, or the twin's log, tell."""
        try:
            if self.twin is not None:
                other = self.twin.reidentified()
            else:
                log = as_episodes(self.mpc.deviations, self.base.pairs)
                other = reidentified(self.mpc, Coordinates.of(self.mpc, log), log)
        except ValueError:  # a model without a steady state or a Riccati solution
            return
        if other is not self.mpc:
            controller = of_model(self.mpc, other)
            self.others["model"] = rollout(controller, self.make, self.seeds, problem=self.mpc)

    def plan(self) -> None:
        """Play plans."""
        plant, low, high = self._plant()
        self.acting = plant
        base = self.base
        unit = max(float(np.abs(base.costs).sum() / base.lengths.sum()), 1e-300)
        task = Task(self.mpc, low, high, _value(self.mpc), WEIGHT * unit)
        pause = PAUSE if self._observer() is not None else 0
        controller = Planning(plant, task, int(base.lengths.max()), pause)
        self.others["plan"] = plans = rollout(controller, self.make, self.seeds, problem=self.mpc)
        lost = -gain(base.costs, plans.costs)
        if (self.doubted or not lost <= WORTH) and self.lacking():
            self.lost = max(float(lost), 0.0)

    def lacking(self) -> bool:
        """Tell whether what plans were made in is a twin of the env that lacks much of it."""
        if not self.random:
            return False
        parts = zip(*(each.steps() for each in self.logged), strict=True)
        steps = [np.concatenate(part) for part in parts]
        return lack_of_fit(self.acting, self.mpc, *steps) > LACKING

    def _plant(self) -> tuple[Plant, Array, Array]:
        """Return what plans are tried in, and the bounds of its states."""
        if self.twin is not None:
            limits, count = self.twin.limits, len(self.twin.dynamics.members)
            acting = TwinPlant(self.twin.dynamics, [s % count for s in self.seeds])
            return acting, limits.low, limits.high
        free, found = np.full(self.mpc.model.n_states, np.inf), self._simulated()
        if found is not None:
            return found, -free, free
        self.random = True  # or so it must be taken to be
        others = rollout(Excited(self.mpc, self.seeds[0]), self.make, self.seeds, problem=self.mpc)
        self.logged = self.base, others
        log = [*self.base.pairs, *others.pairs]
        twin = PlantTwin.fit(self.mpc.deviations, log, observer=self._observer(), n_members=1)
        self.doubted = not twin.trusted
        return TwinPlant(twin.dynamics, [0] * len(self.seeds)), twin.limits.low, twin.limits.high

    def _simulated(self) -> Plant | None:
        """Return the env itself where it can be put into a state, and repeats its steps."""
        observer = self._observer()
        if observer is None:
            return simulated(self.mpc, self.make, *self.base.steps(), self.access)
        row = RowLayout(self.mpc, observer)
        log = [Episode(*row.recovered(*each)) for each in self.base.pairs]
        found = simulated_dynamics(row, self.make, log, self.access)
        return None if found is None else TwinPlant(found, [0] * len(self.seeds))

    def _observer(self) -> DisturbanceObserver | None:
        with closing(self.make()) as env:
            return observer_of(env)

    def found(self) -> Headroom:
        """Return the figures."""
        base = self.base
        fair = {
            name: np.where(loops.no_worse(base), loops.costs, base.costs)
            for name, loops in self.others.items()
        }
        observer, model = (_whole(fair.get(name), base.costs) for name in ("observer", "model"))
        every = (base.costs, *fair.values())
        best = min(every, key=np.mean) if self.random else np.min(every, axis=0)
        total, offset, known = (gain(base.costs, each) for each in (best, observer, model))
        offset, known = min(offset, total), min(known, total)
        parts = offset, max(0.0, known - offset), total - max(offset, known)
        whole = Headroom(base.costs, observer, model, best, *parts, "", self.source, self.d_max)
        verdict = verdict_of(*parts, doubt=SURE * whole.standard_error * self.random)
        if self.lost is not None and verdict_of(*parts) == "do not bother":
            verdict = UNKNOWN
        rest = self._rest() if offset < LITTLE else ""
        played = {
            name: self.others[name].costs if name in self.others else None
            for name in ("observer", "model")
        }
        return dataclasses.replace(
            whole,
            verdict=verdict,
            lost=self.lost,
            rest=rest,
            observer_played=played["observer"],
            reidentified_played=played["model"],
        )

    def _rest(self) -> str:
        """Return what is said of an offset that remains though an observer gains nothing."""
        runs, observer = [x for x, _ in self.base.pairs], self.others.get("observer")
        if observer is None:
            return remaining_offset(self.mpc, runs, None)
        dearer = -gain(self.base.costs, observer.costs)
        return remaining_offset(self.mpc, runs, [x for x, _ in observer.pairs], dearer)


def _name(mpc: LinearMPC, make: Callable[[], gym.Env[Any, Any]]) -> str:
    """Return the name of an env that shows theta and takes the inputs."""
    env = make()
    shape, actions = env.observation_space.shape, env.action_space.shape
    if shape != (mpc.n_theta,) or actions != (mpc.model.n_inputs,):
        raise ValueError(
            f"The env shows {shape} and takes {actions}; theta of the MPC has {mpc.n_theta} "
            f"entries {mpc.layout.names}, and there are {mpc.model.n_inputs} inputs. Wrap the env "
            "so that it shows theta: see PastInputs and ObserveDisturbance in "
            "sb3_yann.wrappers."
        )
    name = getattr(env.spec, "id", type(env.unwrapped).__name__)
    env.close()
    return str(name)


def _whole(costs: Array | None, ours: Array) -> Array:
    """Return the costs of a controller, or the MPC's where those are not worse on average."""
    return ours if costs is None or not costs.mean() < ours.mean() else costs


def _value(mpc: LinearMPC) -> Array:
    """Return the value of the law, discounted a little where there is none without."""
    try:
        return mpc.value_matrix(1.0)
    except ValueError:
        return mpc.value_matrix(0.99)
