"""Where searches in a simulator run: its own episodes are the trials."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.closed_loops import Controller, Loops, of_law
from sb3_yann.commissioning.grounds import Grounds
from sb3_yann.commissioning.simulator_twin import SimulatorTwin
from sb3_yann.commissioning.trial import NEARLY, Check, Inputs, Outcome
from sb3_yann.guard.options import AcceptanceRule
from sb3_yann.guard.statistics import PairedEpisodes, Tolerance


@dataclass
class SimulatedTrial:
    """Episodes of a simulator, and what came of the MPC and of the accepted policy there.

    Attributes
    ----------
    twin : SimulatorTwin
    seeds : range
        Of the episodes.
    rule : AcceptanceRule
        When a policy counts as no worse.
    """

    twin: SimulatorTwin
    seeds: range
    rule: AcceptanceRule
    mpc: Outcome = field(init=False)

    def __post_init__(self) -> None:
        self.base = self.twin.play(of_law(self.twin.problem), self.seeds)
        self.last = self.base
        self.mpc = self._outcome(self.base)

    @property
    def mean(self) -> float:
        """The MPC's mean cost."""
        return max(float(np.abs(self.mpc[0]).mean()), 1e-300)

    @property
    def tolerance(self) -> Tolerance:
        """What starts may cost more."""
        typical = float(np.median(np.abs(self.mpc[0])))
        return Tolerance(self.rule.margin * typical, self.rule.tail, typical)

    def play(self, act: Inputs) -> Outcome:
        """Return what comes of a policy."""
        self.last = self.twin.play(controller_of(act), self.seeds)
        return self._outcome(self.last)

    def _outcome(self, loops: Loops) -> Outcome:
        short = self.base.lengths.max() - loops.lengths
        infinite = ~np.isfinite(loops.costs)
        unsafe = np.column_stack([loops.violations, short, infinite, 0 * short])
        return loops.costs, unsafe.astype(np.int64)

    def check(self, iteration: int, played: Outcome, accepted: Outcome) -> Check:
        """Compare a policy with the accepted one and the MPC, by what came of them."""
        costs, unsafe = played
        allowed = np.minimum(accepted[1], self.mpc[1])
        paired = PairedEpisodes(self.mpc[0], accepted[0], allowed, self.tolerance)
        excess, mean = costs - self.mpc[0], self.mean
        reason = paired.objection(costs, unsafe)
        change, error = excess.mean() / mean, excess.std(ddof=1) / np.sqrt(len(excess)) / mean
        safe = not np.any(unsafe > allowed)
        shown = float(change), float(excess.max() / mean), safe, float(change), float(error)
        return Check(iteration, not reason, reason, *shown)

    def second_objection(self, act: Inputs) -> str:
        """Return nothing: the simulator has spoken."""
        return ""

    def lost(self, played: Outcome) -> Array:
        """Return the numbers of the episodes that a policy loses, or nearly, the worst first."""
        relative = self.tolerance.excess(self.mpc[0], played[0])
        relative[np.any(played[1] > self.mpc[1], axis=1)] = np.inf
        worst = np.argsort(-relative, kind="stable")
        return worst[relative[worst] > NEARLY]

    def hard(self, played: Outcome) -> list[Array]:
        """Return where the episodes begin, or change, that the policy lost last, or nearly."""
        row, given = self.twin.dynamics.row, self.twin.problem.layout.constant
        found = []
        for i in self.lost(played):
            thetas = self.last.thetas[: self.last.lengths[i] + 1, i]
            if not np.isfinite(thetas).all():
                continue
            rows = row.recovered(thetas, self.last.inputs[: self.last.lengths[i], i])[0]
            moved = np.any(np.diff(thetas[:, given], axis=0) != 0, axis=1) & (row.observer is None)
            found.append(rows[[0, *(1 + np.flatnonzero(moved[: len(rows) - 1]))]])
        empty = np.empty((0, row.size))
        return [np.concatenate([empty, *found])]


def controller_of(act: Inputs) -> Controller:
    """Return a policy as what acts in episodes side by side."""

    def controller(t: int, theta: Array, running: Array) -> Array:
        finite = np.isfinite(theta).all(axis=1)
        return act(np.where(finite[:, None], theta, 0.0))

    return controller


@dataclass
class SimulatorGrounds(Grounds):
    """What all searches in a simulator share: see `Grounds`."""

    twin: SimulatorTwin  # type: ignore[assignment]
    rule: AcceptanceRule = AcceptanceRule()

    def __post_init__(self) -> None:
        self.next = self.twin.seeds.stop
        super().__post_init__()

    def draw(self, rng: np.random.Generator) -> SimulatedTrial:  # type: ignore[override]
        """Return a trial on new starts."""
        seeds = range(self.next, self.next + 2 * self.n_starts)
        self.next = seeds.stop
        return SimulatedTrial(self.twin, seeds, self.rule)

    def draw_pool(self, count: int) -> Array:
        """Return rows (count, size) where runs of a gradient begin."""
        starts = self.twin.starts
        half = count // 2
        first = starts.first[self.rng.integers(len(starts.first), size=count - half)]
        return np.concatenate([first, starts.draw_logged(half, self.rng)])
