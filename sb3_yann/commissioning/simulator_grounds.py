"""Where searches in a simulator run: its own episodes are the trials."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import of_law
from sb3_yann.commissioning.grounds import Grounds
from sb3_yann.commissioning.simulator_twin import SimulatorTwin
from sb3_yann.commissioning.trial import NEARLY, Check, Inputs, Outcome
from sb3_yann.compare import (
    AcceptanceRule,
    Scores,
    Tolerance,
    less_safe,
    no_worse,
)
from sb3_yann.control.mpc.bound_excess import BoundNames
from sb3_yann.rollout import Controller, Rows, Trajectories

RULE = AcceptanceRule()
"""When a policy counts as no worse: as a guard has it by default."""
MORE = 3
"""How many times as many episodes as a check has must confirm it."""
FINAL = 12
"""How many confirmations together decide in the end. If none of 2,880 episodes is lost, less than
one in 960 is, with a confidence of 95 %."""


@dataclass
class Comparison:
    """Episodes of a simulator in which policies are compared with the MPC.

    Attributes
    ----------
    mpc : tuple of ndarray
        What came of the MPC.
    bounds : BoundNames
        Of the problem.
    """

    mpc: Outcome = field(init=False)
    bounds: BoundNames = field(init=False)

    @property
    def mean(self) -> float:
        """The MPC's mean cost."""
        return max(float(np.abs(self.mpc[0]).mean()), 1e-300)

    @property
    def tolerance(self) -> Tolerance:
        """What episodes may cost more than with the MPC."""
        return RULE.tolerance(self.mpc[0], self.bounds)

    def check(self, iteration: int, played: Outcome, accepted: Outcome) -> Check:
        """Compare a policy with the accepted one and the MPC, by what came of them."""
        costs, unsafe = played
        allowed = np.minimum(accepted[1], self.mpc[1])  # neither is exceeded
        scores = Scores(*played), Scores(*accepted), Scores(*self.mpc)
        reason, excess = no_worse(*scores, self.tolerance).reason, costs - self.mpc[0]
        # Where a few episodes cost a thousand times as much as most, their mean is never sure.
        own = np.maximum(np.abs(self.mpc[0]), self.tolerance.typical)
        each = excess / np.where(own > 0, own, 1.0)
        error = each.std(ddof=1) / np.sqrt(len(each)) if len(each) > 1 else 0.0
        change, worst = float(excess.mean() / self.mean), float(excess.max() / self.mean)
        safe, logged = not np.any(less_safe(unsafe, allowed)), float(each.mean())
        return Check(iteration, not reason, reason, change, worst, safe, logged, float(error))


@dataclass
class SimulatedTrial(Comparison):
    """Episodes of a simulator, and what came of the MPC there.

    Attributes
    ----------
    twin : SimulatorTwin
    seeds : sequence of int
        Of the episodes. Those where the MPC's own cost is not finite are left out.
    """

    twin: SimulatorTwin
    seeds: Sequence[int]
    base: Trajectories = field(init=False)
    last: Trajectories = field(init=False)

    def __post_init__(self) -> None:
        given, law = self.seeds, of_law(self.twin.problem)
        self.base = self.twin.play(law, given)
        finite = np.isfinite(self.base.costs)
        if not finite.any():
            raise ValueError(
                f"The MPC's own cost is finite in none of {len(given)} episodes of the simulator, "
                "so nothing can be compared there. What it shows must be finite."
            )
        if not finite.all():
            self.seeds = [given[i] for i in np.flatnonzero(finite)]
            self.base = self.twin.play(law, self.seeds)
        self.last = self.base
        self.mpc, self.bounds = self._outcome(self.base), BoundNames.of(self.twin.problem)

    def play(self, act: Inputs) -> Outcome:
        """Return what comes of a policy."""
        self.last = self.twin.play(controller_of(act), self.seeds)
        return self._outcome(self.last)

    def _outcome(self, played: Trajectories) -> Outcome:
        return played.costs, played.unsafe()

    def second_objection(self, act: Inputs) -> str:
        """Return nothing: the simulator has spoken."""
        return ""

    def lost(self, played: Outcome) -> NDArray[np.intp]:
        """Return the numbers of the episodes that a policy loses, or nearly, the worst first."""
        relative = self.tolerance.excess(self.mpc[0], played[0])
        relative[np.any(less_safe(played[1], self.mpc[1]), axis=1)] = np.inf
        worst = np.argsort(-relative, kind="stable")
        return np.asarray(worst[relative[worst] > NEARLY])

    def hard(self, played: Outcome) -> list[Array]:
        """Return where episodes begin, or are given something new, that were lost last."""
        row, constant = self.twin.dynamics.row, self.twin.problem.layout.constant
        found: list[Array] = [np.empty((0, row.size))]
        for i in self.lost(played):
            thetas, inputs = self.last.pairs[i]
            length = len(inputs)
            if not np.isfinite(thetas).all():
                continue
            rows = row.recovered(thetas, inputs)[0][:length]
            new = np.any(np.diff(thetas[:length, constant], axis=0) != 0, axis=1)
            later = np.flatnonzero(new) + 1 if row.observer is None else np.empty(0, np.intp)
            found.append(rows[[0, *later]])
        return [np.concatenate(found)]


@dataclass
class FinalTrial(Comparison):
    """The episodes that decide in the end, some hundred of them side by side.

    Attributes
    ----------
    blocks : sequence of SimulatedTrial
        What is played at a time.
    """

    blocks: Sequence[SimulatedTrial]

    def __post_init__(self) -> None:
        self.mpc = _joined(each.mpc for each in self.blocks)
        self.bounds = self.blocks[0].bounds

    def play(self, act: Inputs) -> Outcome:
        """Return what comes of a policy."""
        return _joined(each.play(act) for each in self.blocks)


def _joined(outcomes: Iterable[Outcome]) -> Outcome:
    costs, unsafe = zip(*outcomes, strict=True)
    return np.concatenate(costs), np.concatenate(unsafe)


def controller_of(act: Inputs) -> Controller:
    """Return a policy as what acts in episodes side by side; on what is not finite, as at rest."""

    def controller(t: int, theta: Array, rows: Rows) -> Array:
        finite = np.isfinite(theta).all(axis=1, keepdims=True)
        return act(np.where(finite, theta, 0.0))

    return controller


@dataclass
class SimulatorGrounds(Grounds):
    """Those of a simulator.

    Attributes
    ----------
    twin : SimulatorTwin
    n_runs, n_starts, seed : int
        As in `Grounds`.
    trial : SimulatedTrial
    next_seed : int
        Of the first episode of the next trial.
    """

    twin: SimulatorTwin
    trial: SimulatedTrial = field(init=False)
    next_seed: int = field(init=False)

    def __post_init__(self) -> None:
        self.next_seed = self.twin.seeds.stop
        super().__post_init__()

    def draw(self, rng: np.random.Generator) -> SimulatedTrial:
        """Return a trial on new starts, more of them than the first one has."""
        first = self.next_seed
        times = 1 if first == self.twin.seeds.stop else MORE
        self.next_seed += 2 * times * self.n_starts
        return SimulatedTrial(self.twin, range(first, self.next_seed))

    def draw_final(self) -> FinalTrial:
        """Return the episodes that decide in the end, new ones."""
        return FinalTrial([self.draw(self.drawing) for _ in range(FINAL)])

    def draw_pool(self, count: int) -> Array:
        """Return rows (count, size): beginnings of the MPC's episodes, and what comes later."""
        starts, half = self.twin.starts, count // 2
        first = starts.row.begin(starts.first[self.rng.integers(len(starts.first), size=half)])
        return np.concatenate([first, starts.draw_logged(count - half, self.rng)])
