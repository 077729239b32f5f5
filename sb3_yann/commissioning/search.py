"""The search for a better actor in a twin: gradient steps, and checks against the MPC."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.commissioning.grounds import Grounds, Valued
from sb3_yann.commissioning.trial import Check
from sb3_yann.networks import RowAdam
from sb3_yann.networks.yann import LawLayer
from sb3_yann.twin.gradient import accumulate_gradient, actor

PLATEAU = 1e-4
"""A gain from one check to the next, relative to the MPC's cost, that is not worth another."""
MOST = 3.0
"""How many times as much a run may count at most that costs less than the mean one."""
EMPHASIS = 100.0
"""How many times as much a run counts that costs more than with the MPC."""
ROUNDING = 1e-9
"""Of a cost: so much more is the same."""
HARDEST, SHARE = 50, 0.6
"""How many new hard starts each member keeps; the share of hard ones in a gradient's runs."""
RETREATS = 1.0, 0.5, 0.25
"""Of the way from the accepted policy to the present one: what is checked until one passes."""


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
    grounds : Grounds
        Where it runs; not changed.
    pace : Pace
    """

    def __init__(self, layer: LawLayer, grounds: Grounds, pace: Pace) -> None:
        self.layer, self.grounds, self.pace, twin = layer, grounds, pace, grounds.twin
        self.rng, self.drawing = copy.deepcopy(grounds.rng), copy.deepcopy(grounds.drawing)
        self.outcome = grounds.trial.mpc
        nothing: list[Array] = [np.empty((0, twin.dynamics.row.size))] * len(twin.dynamics.members)
        self.known_hard = self.new_hard = nothing
        self.hard = [(each[:0], costs[:0]) for each, costs in grounds.pool]
        self.accepted = copy.deepcopy(layer.state_dict())
        self.earliest: dict[str, th.Tensor] | None = None  # of all that were accepted
        kind = RowAdam if layer.row_gradients else th.optim.Adam
        self.optimizer: Any = kind(layer.network.weights())
        self.iteration = self.refused = 0
        self.checks: list[Check] = []
        if not layer.network.is_zero():  # what has been learnt before must pass here as well
            self.accepted = _without_correction(self.accepted)
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
        return self.best.change if self.best else 0.0

    @property
    def best(self) -> Check | None:
        """The check of the accepted weights; None where none are."""
        return next((each for each in reversed(decisive(self.checks)) if each.accepted), None)

    def gains(self, least: float) -> bool:
        """Return whether the accepted weights gain so much, and surely something."""
        return self.best is not None and self.best.gains(least)

    def confirm(self, least: float) -> bool:
        """Return whether the accepted weights gain so much in the final trial, if there is one.

        Where they do not, those are tried that were accepted first, then half and a quarter of the
        correction.
        """
        if not self.gains(least):
            return False
        final = self.grounds.draw_final()
        if final is None:
            return True
        for weights in self._retreats():
            self.accepted = weights
            self.layer.load_state_dict(weights)
            played = final.play(actor(self.layer, self.grounds.twin.problem))
            found = final.check(self.iteration, played, final.mpc)
            reason = found.reason and f"in the final trial, {found.reason}"
            self.checks.append(replace(found, reason=reason, final=True))
            if found.accepted and found.gains(least):
                return True
        return False

    def _retreats(self) -> list[dict[str, th.Tensor]]:
        """Return what is left of the accepted weights, from all of it on."""
        whole, mpc = self.accepted, _without_correction(self.accepted)
        earliest = [each for each in [self.earliest] if each is not None and each is not whole]
        return [whole, *earliest, *(_between(mpc, whole, share) for share in RETREATS[1:])]

    def _check(self) -> bool:
        """Check the present actor, else what lies between it and the accepted one."""
        present = copy.deepcopy(self.layer.state_dict())
        for share in RETREATS:
            weights = _between(self.accepted, present, share)
            self.layer.load_state_dict(weights)
            self.checks.append(self._try())
            if self.checks[-1].accepted:
                self.accepted = weights
                self.earliest = self.earliest or weights
                break
        self.layer.load_state_dict(present)
        self._value_hard_starts()
        return self.checks[-1].accepted

    def _try(self) -> Check:
        """Check the layer on the known starts, then on new ones; learn from what it loses."""
        trial, act = self.grounds.trial, actor(self.layer, self.grounds.twin.problem)
        played = trial.play(act)
        found = trial.check(self.iteration, played, self.outcome)
        self.known_hard = trial.hard(played)
        if not found.accepted:
            return found
        new = self.grounds.draw(self.drawing)
        there = new.play(act)
        pairs = zip(new.hard(there), self.new_hard, strict=True)
        self.new_hard = [np.concatenate(each)[:HARDEST] for each in pairs]
        confirmed = new.check(self.iteration, there, new.mpc)
        if not confirmed.accepted:
            return replace(found, accepted=False, reason=f"on new starts, {confirmed.reason}")
        if doubt := new.second_objection(act):
            return replace(found, accepted=False, reason=doubt)
        self.outcome = played
        return found

    def _step(self) -> None:
        self.optimizer.zero_grad()
        grounds = self.grounds
        chosen = [self._chosen(*each) for each in zip(grounds.pool, self.hard, strict=True)]
        starts, mpc = (np.array(each) for each in zip(*chosen, strict=True))
        # Relative costs count: starts around the log may be many times as dear as those in it.
        weights = np.minimum(MOST, grounds.trial.mean / np.maximum(np.abs(mpc), 1e-300))
        # Rounding must not tell which runs cost more: at first all cost what the MPC costs.
        reference = mpc + ROUNDING * np.abs(mpc), weights, weights * (1 + EMPHASIS)
        dynamics, objective, length = grounds.twin.dynamics, grounds.objective, grounds.length
        with np.errstate(all="ignore"):
            accumulate_gradient(self.layer, dynamics, objective, starts, length, reference)
        if all(each.grad is None or _finite(each.grad) for each in self.layer.network.weights()):
            self.optimizer.step()

    def _chosen(self, pool: Valued, hard: Valued) -> Valued:
        """Return the starts of one member's runs, and what they cost with the MPC."""
        batch = self.grounds.batch
        first = self.rng.permutation(len(hard[0]))[: int(SHARE * batch)]
        rest = self.rng.permutation(len(pool[0]))[: batch - len(first)]
        starts, costs = ((a[first], b[rest]) for a, b in zip(hard, pool, strict=True))
        return np.concatenate(starts), np.concatenate(costs)

    def _value_hard_starts(self) -> None:
        hard = [np.concatenate(each) for each in zip(self.known_hard, self.new_hard, strict=True)]
        most = max(map(len, hard))
        filled = zip(hard, self.grounds.pool, strict=True)  # every member runs as many
        starts = np.array([[*rows, *pool[0][: most - len(rows)]] for rows, pool in filled])
        costs = self.grounds.costs_of_mpc(starts) if most else np.empty((len(hard), 0))
        self.hard = [(rows, known[: len(rows)]) for rows, known in zip(hard, costs, strict=True)]


def decisive(checks: Sequence[Check]) -> Sequence[Check]:
    """Return the checks of the final trial; all of them where there was none."""
    return [each for each in checks if each.final] or checks


def _without_correction(weights: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    """Return the weights of the MPC: a part of the way from them is a part of the correction."""
    last = [key for key in weights if key.startswith("network.rest.")][-1]
    return weights | {last: th.zeros_like(weights[last])}


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
