"""The search for a better actor in a twin: gradient steps, and checks against the MPC."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.commissioning.trial import Check, Trial
from sb3_yann.control import LinearMPC, lqr
from sb3_yann.networks import RowAdam
from sb3_yann.networks.law_layer import LawLayer
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.gradient import Objective, accumulate_gradient, actor_inputs
from sb3_yann.twin.plant_twin import PlantTwin

LONGEST = 150
"""Steps of an unrolled run, at most."""
SETTLED = 0.05
"""A run is so long that a deviation shrinks to this, if it may."""
PLATEAU = 1e-4
"""A gain from one check to the next, relative to the MPC's cost, that is not worth another."""
MOST = 3.0
"""How many times as much a run may count at most that costs less than the mean one."""
EMPHASIS = 100.0
"""How many times as much a run counts that costs more than with the MPC."""
HARDEST, SHARE = 50, 0.6
"""How many new hard starts each member keeps; the share of hard ones in a gradient's runs."""
PENALTY = 10.0
"""Of a step one half-width beyond a limit, in mean costs of a run."""


class Search:
    """A copy of an actor's layer that follows the gradient of its cost in a twin.

    Parameters
    ----------
    layer : LawLayer
        On the CPU; it is moved.
    twin : PlantTwin
    batch : int
        Runs in each gradient, shared out among the members.
    n_starts : int
        Of a check, for each member, twice: as the log begins, and around.
    seed : int
    """

    def __init__(
        self, layer: LawLayer, twin: PlantTwin, batch: int, n_starts: int, seed: int
    ) -> None:
        self.layer, self.twin, problem = layer, twin, twin.problem
        members, checked = len(twin.dynamics.members), np.random.default_rng([seed, 1])
        self.shape, self.rng = (members, max(1, batch // members)), np.random.default_rng(seed)
        longest = max(map(len, twin.episodes))
        self.steps = min(LONGEST, longest, settling_steps(problem))
        self.n_starts, self.checked, self.longest = n_starts, checked, longest
        self.trial = self._draw()
        self.outcome = self.trial.mpc
        nothing: list[Array] = [np.empty((0, problem.n_theta))] * members
        self.known_hard = self.new_hard = nothing
        penalty, value = PENALTY * self.trial.mean, _value(problem)
        self.objective = Objective(problem, value, twin.limits.low, twin.limits.high, penalty)
        self.accepted, self.law = copy.deepcopy(layer.state_dict()), law_of(problem)
        self.checks: list[Check] = []
        if not layer.network.is_zero():  # what has been learnt before must pass here as well
            last = [key for key in self.accepted if key.startswith("network.rest.")][-1]
            self.accepted[last].zero_()  # the MPC
            self._check(0)

    def run(
        self, iterations: Any, count: int, learning_rate: float, every: int, patience: int
    ) -> None:
        """Take gradient steps; leave all checks in ``checks``, and the weights in ``accepted``.

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
        checks = self.checks
        refused, last = 0, 0.0
        for k in iterations:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * (1 - k / count)
            self._step(optimizer)
            if (k + 1) % every and k + 1 < count:
                continue
            passed = self._check(k + 1)
            refused = 0 if passed else refused + 1
            stalls = passed and k + 1 > every and last - checks[-1].change < PLATEAU
            last = checks[-1].change if passed else last
            if stalls or refused >= patience:
                break

    @property
    def change(self) -> float:
        """Mean cost of the accepted weights against the MPC's in the twin; 0 where none are."""
        return next((each.change for each in reversed(self.checks) if each.accepted), 0.0)

    def _draw(self) -> Trial:
        """Return a trial on new starts, the same for every member."""
        count, starts = self.n_starts, self.twin.starts
        drawn = starts.draw(count, self.checked), starts.draw_around(count, self.checked)
        rows = np.repeat(np.concatenate(drawn)[None], len(self.twin.dynamics.members), axis=0)
        return Trial(self.twin, rows, count, self.longest)

    def _check(self, iteration: int) -> bool:
        """Check the present actor, else the one halfway from the accepted one."""
        present = copy.deepcopy(self.layer.state_dict())
        for weights in (present, _halfway(self.accepted, present)):
            self.layer.load_state_dict(weights)
            self.checks.append(self._try(iteration))
            if self.checks[-1].accepted:
                self.accepted = weights
                break
        self.layer.load_state_dict(present)
        return self.checks[-1].accepted

    def _try(self, iteration: int) -> Check:
        """Check the layer on the known starts, then on new ones; learn from what it loses."""
        played = self.trial.play(self._inputs)
        found = self.trial.check(iteration, played, self.outcome)
        self.known_hard = self.trial.hard(played)
        if not found.accepted:
            return found
        new = self._draw()
        there = new.play(self._inputs)
        pairs = zip(new.hard(there), self.new_hard, strict=True)
        self.new_hard = [np.concatenate(each)[:HARDEST] for each in pairs]
        confirmed = new.check(iteration, there, new.mpc)
        if not confirmed.accepted:
            return replace(found, accepted=False, reason=f"on new starts, {confirmed.reason}")
        self.outcome = played
        return found

    def _step(self, optimizer: Any) -> None:
        optimizer.zero_grad()
        members, batch = self.shape
        drawn = self.twin.starts.draw_anywhere(members * batch, self.rng)
        starts = self.rng.permutation(drawn).reshape(members, batch, -1)
        for i, hard in enumerate(zip(self.known_hard, self.new_hard, strict=True)):
            chosen = self.rng.permutation(np.concatenate(hard))[: int(SHARE * batch)]
            starts[i, : len(chosen)] = chosen
        dynamics = self.twin.dynamics
        with np.errstate(all="ignore"):
            runs = dynamics.roll_out(self.law, starts, self.steps)
            mpc = self.objective.costs(*runs)
            # Relative costs count: starts around the log may be many times as dear as those in it.
            weights = np.minimum(MOST, self.trial.mean / np.maximum(np.abs(mpc), 1e-300))
            reference = mpc, weights, weights * (1 + EMPHASIS)
            accumulate_gradient(self.layer, dynamics, self.objective, starts, self.steps, reference)
        if all(each.grad is None or _finite(each.grad) for each in self.layer.network.weights()):
            optimizer.step()

    def _inputs(self, theta: Array) -> Array:
        return actor_inputs(self.layer, self.twin.problem, theta)


def settling_steps(problem: LinearMPC) -> int:
    """Return after how many steps of the linear closed loop little is left of a deviation."""
    law, layout, numbers = problem.law(), problem.layout, np.arange(problem.n_theta)
    A, B = problem.prediction
    moving = np.concatenate([numbers[layout.state], numbers[layout.previous]])
    gain = law.gain(np.zeros(problem.n_theta))
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


def _halfway(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    return {
        key: th.lerp(value, second[key], 0.5) if key.startswith("network.") else value
        for key, value in first.items()
    }
