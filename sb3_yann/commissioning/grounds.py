"""Where searches run: starts, what the MPC costs from them, what is minimized."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.commissioning.simulator_twin import SimulatorTwin
from sb3_yann.commissioning.trial import Check, Inputs, Outcome, Trial
from sb3_yann.control import LinearMPC, lqr
from sb3_yann.twin.dynamics import law_of
from sb3_yann.twin.gradient import Objective
from sb3_yann.twin.plant_twin import PlantTwin

LONGEST = 150
"""Steps of an unrolled run, at most."""
SETTLED = 0.05
"""A run is so long that a deviation shrinks to this, if it may."""
POOL = 400
"""Starts of each member that gradients draw from; what they cost with the MPC is known."""
PENALTY = 10.0
"""Of a step one half-width beyond a limit, in mean costs of a run."""

Valued = tuple[Array, Array]
"""Starts (rows, n_theta), and costs (rows,)."""


class Compared(Protocol):
    """Starts from which policies are compared with the MPC."""

    mpc: Outcome

    def play(self, act: Inputs) -> Outcome:
        """Return what comes of a policy."""

    def check(self, iteration: int, played: Outcome, accepted: Outcome) -> Check:
        """Compare a policy with the accepted one and the MPC, by what came of them."""


class Paired(Compared, Protocol):
    """Starts that tell a search as well what it loses."""

    @property
    def mean(self) -> float:
        """The MPC's mean cost."""

    def second_objection(self, act: Inputs) -> str:
        """Return what else speaks against a policy; empty where nothing."""

    def hard(self, played: Outcome) -> list[Array]:
        """Return the starts of each member that a policy loses, or nearly."""


@dataclass
class Grounds(ABC):
    """What all searches share: one trial, and a pool of starts for gradients.

    Attributes
    ----------
    twin : PlantTwin or SimulatorTwin
    n_runs : int
        Runs in each gradient, shared out among the members: ``batch`` for each.
    n_starts : int
        Of a trial, for each member, twice: as the log begins, and around; those of a simulator's
        trial, twice.
    seed : int
    """

    twin: PlantTwin | SimulatorTwin
    n_runs: int
    n_starts: int
    seed: int
    drawing: np.random.Generator = field(init=False)
    rng: np.random.Generator = field(init=False)
    length: int = field(init=False)
    trial: Paired = field(init=False)
    objective: Objective = field(init=False)
    pool: list[Valued] = field(init=False)

    def __post_init__(self) -> None:
        twin, problem, members = self.twin, self.twin.problem, len(self.twin.dynamics.members)
        self.drawing, self.rng = (
            np.random.default_rng(each) for each in ([self.seed, 1], self.seed)
        )
        self.length = min(LONGEST, max(map(len, twin.episodes)), settling_steps(problem))
        self.trial = self.draw(self.drawing)
        penalty, value = PENALTY * self.trial.mean, value_at_end(problem)
        self.objective = Objective(problem, value, twin.limits.low, twin.limits.high, penalty)
        starts = self.rng.permutation(self.draw_pool(members * POOL)).reshape(members, POOL, -1)
        self.pool = [*zip(starts, self.costs_of_mpc(starts), strict=True)]

    @property
    def batch(self) -> int:
        """Runs of each member in a gradient."""
        return max(1, self.n_runs // len(self.twin.dynamics.members))

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> Paired:
        """Return a trial on new starts."""

    def draw_final(self) -> Compared | None:
        """Return the trial that decides in the end; None where every check has decided."""
        return None

    @abstractmethod
    def draw_pool(self, count: int) -> Array:
        """Return rows (count, size) where runs of a gradient begin."""

    def costs_of_mpc(self, starts: Array) -> Array:
        """Return the MPC's costs (members, starts) of the runs of a gradient."""
        with np.errstate(all="ignore"):
            runs = self.twin.dynamics.roll_out(law_of(self.twin.problem), starts, self.length)
            return self.objective.costs(*runs)


@dataclass
class TwinGrounds(Grounds):
    """Those of a twin.

    Attributes
    ----------
    twin : PlantTwin
    n_runs, n_starts, seed : int
        As in `Grounds`.
    """

    twin: PlantTwin

    def draw(self, rng: np.random.Generator) -> Trial:
        """Return a trial on new starts, the same for every member.

        Those that begin as the log does go on so, one logged episode after the other: a policy that
        gains at set-points that stay may lose where they change. Every other one has set-points
        between those of the log, which stay.
        """
        count, starts, twin = self.n_starts, self.twin.starts, self.twin
        drawn = np.concatenate([starts.draw_between(count, rng), starts.draw_around(count, rng)])
        between = twin.dynamics.row.given.start < twin.dynamics.row.given.stop
        follow = np.full(len(drawn), -1)
        logged = np.arange(count)[int(between) :: 1 + between]
        follow[logged] = np.arange(len(logged)) % len(twin.episodes)
        drawn[logged] = starts.draw(len(logged), rng, follow[logged])
        rows = np.repeat(drawn[None], len(twin.dynamics.members), axis=0)
        return Trial(twin, rows, count, follow)

    def draw_pool(self, count: int) -> Array:
        """Return rows (count, size): beginnings, logged ones, and what lies around."""
        return self.twin.starts.draw_anywhere(count, self.rng)


def settling_steps(problem: LinearMPC) -> int:
    """Return after how many steps of the linear closed loop little is left of a deviation."""
    law, layout, numbers = problem.law(), problem.layout, np.arange(problem.n_theta)
    A, B = problem.prediction
    moving = np.concatenate([numbers[layout.state], numbers[layout.previous]])
    gain = law.gain(np.zeros(problem.n_theta))
    radius = lqr.spectral_radius((A + B @ gain)[np.ix_(moving, moving)])
    return int(np.ceil(np.log(SETTLED) / np.log(radius))) if 0 < radius < 1 else LONGEST


def value_at_end(problem: LinearMPC) -> Array:
    """Return the undiscounted value of the law, or one discounted a little where there is none."""
    try:
        return problem.value_matrix(1.0)
    except ValueError:
        return problem.value_matrix(0.99)
