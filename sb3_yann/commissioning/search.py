"""The search for a better actor in a twin: gradient steps, and checks against the MPC."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC, lqr
from sb3_yann.guard.statistics import PairedEpisodes
from sb3_yann.networks import RowAdam, YannLayer
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.gradient import Objective, accumulate_gradient, actor_inputs
from sb3_yann.twin.plant_twin import PlantTwin

LONGEST = 150
"""Steps of an unrolled run, at most."""
SETTLED = 0.05
"""A run is so long that a deviation shrinks to this, if it may."""
PLATEAU = 1e-4
"""A gain from one check to the next, relative to the MPC's cost, that is not worth another."""
MARGIN = 3e-3
"""What one start may cost more than with the MPC on one member, in mean costs of the MPC."""
AROUND = 0.01
"""What a start outside the log may cost more besides, as a fraction of the MPC's cost of it."""
EMPHASIS = 20.0
"""How many times as much a run counts that costs more than with the MPC."""
PENALTY = 10.0
"""Of a step one half-width beyond a limit, in mean costs of a run."""

Inputs = Callable[[Array], Array]
Outcome = tuple[Array, NDArray[np.int64]]
"""Costs, and what is unsafe, of all starts."""


@dataclass(frozen=True)
class Check:
    """One comparison with the MPC in the twin.

    Attributes
    ----------
    iteration : int
    accepted : bool
    reason : str
        Why not; empty where it was.
    change : float
        Mean cost against the MPC's, over all starts and members: -0.02 is 2 % less.
    worst : float
        The largest increase of one start on one member, in mean costs of the MPC.
    """

    iteration: int
    accepted: bool
    reason: str
    change: float
    worst: float


@dataclass
class Trial:
    """Starts on every member, and what came of the MPC and of the accepted policy there.

    Attributes
    ----------
    act : callable
        The actor, from theta (rows, n_theta) to inputs (rows, m).
    twin : PlantTwin
    starts : ndarray, shape (members, starts, n_theta)
        The first ``n_known`` of each member begin as the log does, the others around it.
    n_known, steps : int
    """

    act: Inputs
    twin: PlantTwin
    starts: Array
    n_known: int
    steps: int
    mpc: Outcome = field(init=False)
    accepted: Outcome = field(init=False)

    def __post_init__(self) -> None:
        self.mpc = self.play(law_of(self.twin.problem))
        self.accepted = self.play(self.act)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which of all starts, member by member, begin as the log does."""
        return np.tile(np.arange(self.starts.shape[1]) < self.n_known, len(self.starts))

    @property
    def mean(self) -> float:
        """The MPC's mean cost from them."""
        return float(np.abs(self.mpc[0][self.known]).mean())

    def play(self, act: Inputs) -> Outcome:
        """Return what comes of a policy."""
        twin = self.twin
        with np.errstate(all="ignore"):
            thetas, inputs = twin.dynamics.roll_out(act, self.starts, self.steps)
            costs = twin.problem.stage_cost(thetas[:-1], inputs).sum(axis=0).ravel()
        left = twin.limits.violated(thetas[1:]).sum(axis=0).ravel() * self.known
        broken = twin.limits.broken(thetas[1:]).sum(axis=0).ravel()
        unsafe = np.column_stack([left + broken, 0 * left, ~np.isfinite(costs)])
        return costs, unsafe.astype(np.int64)

    def check(self, iteration: int) -> Check:
        """Compare the present actor with the accepted policy and the MPC."""
        costs, unsafe = self.play(self.act)
        known, mean, mpc = self.known, self.mean, self.mpc[0]
        safe = np.minimum(self.accepted[1], self.mpc[1])  # neither is exceeded
        paired = PairedEpisodes(mpc[known], self.accepted[0][known], safe[known], MARGIN * mean)
        reason = paired.objection(costs[known], unsafe[known])
        if not reason and np.any(unsafe > safe):
            reason = "a start outside the log breaks a bound of the problem"
        excess = costs - mpc
        around = (excess - MARGIN * mean - AROUND * np.abs(mpc))[~known]
        if not reason and not np.all(around <= 0):
            reason = f"a start outside the log costs {excess[~known][np.argmax(around)]:.4g} more"
        if not reason:
            self.accepted = costs, unsafe
        change, worst = float(excess[known].mean()), float(excess[known].max())
        return Check(iteration, not reason, reason, change / mean, worst / mean)


class Search:
    """A copy of an actor's layer that follows the gradient of its cost in a twin.

    Parameters
    ----------
    layer : YannLayer
        On the CPU; it is moved.
    twin : PlantTwin
    batch : int
        Runs in each gradient, shared out among the members.
    n_starts : int
        Of a check, for each member, twice: as the log begins, and around.
    seed : int
    """

    def __init__(
        self, layer: YannLayer, twin: PlantTwin, batch: int, n_starts: int, seed: int
    ) -> None:
        self.layer, self.twin, problem = layer, twin, twin.problem
        members, checked = len(twin.dynamics.members), np.random.default_rng([seed, 1])
        self.shape, self.rng = (members, max(1, batch // members)), np.random.default_rng(seed)
        longest = max(map(len, twin.episodes))
        self.steps = min(LONGEST, longest, settling_steps(problem))
        drawn = twin.starts.draw(n_starts, checked), twin.starts.draw_around(n_starts, checked)
        starts = np.repeat(np.concatenate(drawn)[None], members, axis=0)
        self.trial = Trial(self._inputs, twin, starts, n_starts, longest)
        penalty, value = PENALTY * self.trial.mean, _value(problem)
        self.objective = Objective(problem, value, twin.limits.low, twin.limits.high, penalty)
        self.accepted, self.law = copy.deepcopy(layer.state_dict()), law_of(problem)

    def run(
        self, iterations: Any, count: int, learning_rate: float, every: int, patience: int
    ) -> list[Check]:
        """Take gradient steps; leave the accepted weights in ``accepted``.

        Parameters
        ----------
        iterations : iterable of int
            From 0 on.
        count : int
            How many.
        learning_rate : float
            Of Adam at first.
        every : int
            Steps from one check to the next.
        patience : int
            Checks without an acceptance after which to stop.
        """
        kind = RowAdam if self.layer.row_gradients else th.optim.Adam
        optimizer: Any = kind(self.layer.network.weights(), lr=learning_rate)
        checks: list[Check] = []
        refused, last = 0, 0.0
        for k in iterations:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * (1 - k / count)
            self._step(optimizer)
            if (k + 1) % every and k + 1 < count:
                continue
            passed = self._check(checks, k + 1)
            refused = 0 if passed else refused + 1
            stalls = passed and k + 1 > every and last - checks[-1].change < PLATEAU
            last = checks[-1].change if passed else last
            if stalls or refused >= patience:
                break
        return checks

    def _check(self, checks: list[Check], iteration: int) -> bool:
        """Check the present actor, else the one halfway from the accepted one."""
        present = copy.deepcopy(self.layer.state_dict())
        whole = self.trial.check(iteration)
        checks.append(whole)
        if whole.accepted:
            self.accepted = present
            return True
        halfway = {
            key: th.lerp(value, present[key], 0.5) if key.startswith("network.") else value
            for key, value in self.accepted.items()
        }
        self.layer.load_state_dict(halfway)
        half = self.trial.check(iteration)
        checks.append(half)
        self.layer.load_state_dict(present)
        if half.accepted:
            self.accepted = halfway
        return half.accepted

    def _step(self, optimizer: Any) -> None:
        optimizer.zero_grad()
        members, batch = self.shape
        drawn = self.twin.starts.draw_anywhere(members * batch, self.rng)
        starts = self.rng.permutation(drawn).reshape(members, batch, -1)
        dynamics = self.twin.dynamics
        with np.errstate(all="ignore"):
            runs = dynamics.roll_out(self.law, starts, self.steps)
            mpc = self.objective.costs(*runs)
            # Starts around the log may be many times as dear: none counts for more than one of it.
            weights = np.minimum(1.0, self.trial.mean / np.maximum(np.abs(mpc), 1e-300))
            reference = mpc, weights, weights * (1 + EMPHASIS)
            accumulate_gradient(self.layer, dynamics, self.objective, starts, self.steps, reference)
        if all(each.grad is None or _finite(each.grad) for each in self.layer.network.weights()):
            optimizer.step()

    def _inputs(self, theta: Array) -> Array:
        return actor_inputs(self.layer, self.twin.problem, theta)


def settling_steps(problem: LinearMPC) -> int:
    """Return after how many steps of the linear closed loop little is left of a deviation."""
    law, layout, numbers = problem.explicit(), problem.layout, np.arange(problem.n_theta)
    A, B = problem.prediction
    moving = np.concatenate([numbers[layout.state], numbers[layout.previous]])
    gain = law.gains[law.locate(np.zeros(problem.n_theta))]
    radius = lqr.spectral_radius((A + B @ gain)[np.ix_(moving, moving)])
    return int(np.ceil(np.log(SETTLED) / np.log(radius))) if 0 < radius < 1 else LONGEST


def _value(problem: LinearMPC) -> Array:
    """Return the undiscounted value of the law, or one discounted a little where there is none."""
    try:
        return problem.value_matrix(1.0)
    except ValueError:
        return problem.value_matrix(0.99)


def _finite(gradient: th.Tensor) -> bool:
    values = gradient._values() if gradient.is_sparse else gradient
    return bool(values.isfinite().all())
