"""The search for a better actor in a twin: gradient steps, and checks against the MPC."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
RETREATS = 1.0, 0.5, 0.25
"""Of the way from the accepted policy to the present one: what is checked until one passes."""
POOL = 400
"""Starts of each member that gradients draw from; what they cost with the MPC is known."""
PENALTY = 10.0
"""Of a step one half-width beyond a limit, in mean costs of a run."""

Valued = tuple[Array, Array]
"""Starts (rows, n_theta), and costs (rows,)."""


@dataclass(frozen=True)
class Pace:
    """How a search proceeds.

    Attributes
    ----------
    iterations : int
        Gradient steps, at most.
    learning_rate : float
        Of Adam at first; it falls to zero.
    check_every : int
        Steps from one check to the next.
    patience : int
        Checks without an acceptance after which to stop.
    """

    iterations: int
    learning_rate: float
    check_every: int
    patience: int


class Search:
    """A copy of an actor's layer that follows the gradient of its cost in a twin.

    Parameters
    ----------
    layer : LawLayer
        On the CPU; it is moved.
    twin : PlantTwin
    pace : Pace
    batch : int
        Runs in each gradient, shared out among the members.
    n_starts : int
        Of a check, for each member, twice: as the log begins, and around.
    seed : int
    """

    def __init__(
        self,
        layer: LawLayer,
        twin: PlantTwin,
        pace: Pace,
        batch: int,
        n_starts: int,
        seed: int,
    ) -> None:
        self.layer, self.twin, self.pace, problem = layer, twin, pace, twin.problem
        members, checked = len(twin.dynamics.members), np.random.default_rng([seed, 1])
        self.shape, self.rng = (members, max(1, batch // members)), np.random.default_rng(seed)
        longest = max(map(len, twin.episodes))
        self.length = min(LONGEST, longest, settling_steps(problem))
        self.n_starts, self.checked, self.longest = n_starts, checked, longest
        self.trial = self._draw()
        self.outcome = self.trial.mpc
        nothing: list[Array] = [np.empty((0, problem.n_theta))] * members
        self.known_hard = self.new_hard = nothing
        penalty, value = PENALTY * self.trial.mean, _value(problem)
        self.objective = Objective(problem, value, twin.limits.low, twin.limits.high, penalty)
        drawn = self.rng.permutation(twin.starts.draw_anywhere(members * POOL, self.rng))
        starts = drawn.reshape(members, POOL, -1)
        self.pool = [*zip(starts, self._costs_of_mpc(starts), strict=True)]
        self.hard = [(each[:0], costs[:0]) for each, costs in self.pool]
        self.accepted = copy.deepcopy(layer.state_dict())
        kind = RowAdam if layer.row_gradients else th.optim.Adam
        self.optimizer: Any = kind(layer.network.weights())
        self.iteration = self.refused = 0
        self.checks: list[Check] = []
        if not layer.network.is_zero():  # what has been learnt before must pass here as well
            last = [key for key in self.accepted if key.startswith("network.rest.")][-1]
            self.accepted[last].zero_()  # the MPC
            self._check()

    def steps(self, until: int) -> Iterator[int]:
        """Yield after each gradient step up to iteration ``until``, or until it stalls.

        All checks are in ``checks`` then, and the weights in ``accepted``.
        """
        pace = self.pace
        while self.iteration < until and self.refused < pace.patience:
            for group in self.optimizer.param_groups:
                group["lr"] = pace.learning_rate * (1 - self.iteration / pace.iterations)
            self._step()
            self.iteration += 1
            if self.iteration % pace.check_every == 0 or self.iteration == pace.iterations:
                before, passed = self.change, self._check()
                self.refused = 0 if passed else self.refused + 1
                if passed and self.iteration > pace.check_every and before - self.change < PLATEAU:
                    self.refused = pace.patience  # it stalls
            yield self.iteration

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

    def _check(self) -> bool:
        """Check the present actor, else what lies between it and the accepted one."""
        present = copy.deepcopy(self.layer.state_dict())
        for share in RETREATS:
            weights = _between(self.accepted, present, share)
            self.layer.load_state_dict(weights)
            self.checks.append(self._try())
            if self.checks[-1].accepted:
                self.accepted = weights
                break
        self.layer.load_state_dict(present)
        self._value_hard_starts()
        return self.checks[-1].accepted

    def _try(self) -> Check:
        """Check the layer on the known starts, then on new ones; learn from what it loses."""
        played = self.trial.play(self._inputs)
        found = self.trial.check(self.iteration, played, self.outcome)
        self.known_hard = self.trial.hard(played)
        if not found.accepted:
            return found
        new = self._draw()
        there = new.play(self._inputs)
        pairs = zip(new.hard(there), self.new_hard, strict=True)
        self.new_hard = [np.concatenate(each)[:HARDEST] for each in pairs]
        confirmed = new.check(self.iteration, there, new.mpc)
        if not confirmed.accepted:
            return replace(found, accepted=False, reason=f"on new starts, {confirmed.reason}")
        self.outcome = played
        return found

    def _step(self) -> None:
        self.optimizer.zero_grad()
        chosen = [self._chosen(*each) for each in zip(self.pool, self.hard, strict=True)]
        starts, mpc = (np.array(each) for each in zip(*chosen, strict=True))
        # Relative costs count: starts around the log may be many times as dear as those in it.
        weights = np.minimum(MOST, self.trial.mean / np.maximum(np.abs(mpc), 1e-300))
        reference = mpc, weights, weights * (1 + EMPHASIS)
        dynamics, length = self.twin.dynamics, self.length
        with np.errstate(all="ignore"):
            accumulate_gradient(self.layer, dynamics, self.objective, starts, length, reference)
        if all(each.grad is None or _finite(each.grad) for each in self.layer.network.weights()):
            self.optimizer.step()

    def _chosen(self, pool: Valued, hard: Valued) -> Valued:
        """Return the starts of one member's runs, and what they cost with the MPC."""
        batch = self.shape[1]
        first = self.rng.permutation(len(hard[0]))[: int(SHARE * batch)]
        rest = self.rng.permutation(len(pool[0]))[: batch - len(first)]
        starts, costs = ((a[first], b[rest]) for a, b in zip(hard, pool, strict=True))
        return np.concatenate(starts), np.concatenate(costs)

    def _costs_of_mpc(self, starts: Array) -> Array:
        with np.errstate(all="ignore"):
            runs = self.twin.dynamics.roll_out(law_of(self.twin.problem), starts, self.length)
            return self.objective.costs(*runs)

    def _value_hard_starts(self) -> None:
        hard = [np.concatenate(each) for each in zip(self.known_hard, self.new_hard, strict=True)]
        most = max(map(len, hard))
        filled = zip(hard, self.pool, strict=True)  # every member runs as many
        starts = np.array([[*rows, *pool[0][: most - len(rows)]] for rows, pool in filled])
        costs = self._costs_of_mpc(starts) if most else np.empty((len(hard), 0))
        self.hard = [(rows, known[: len(rows)]) for rows, known in zip(hard, costs, strict=True)]

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


def _between(
    first: dict[str, th.Tensor], second: dict[str, th.Tensor], share: float
) -> dict[str, th.Tensor]:
    return {
        key: th.lerp(first[key], value, share) if key.startswith("network.") else value
        for key, value in second.items()
    }
