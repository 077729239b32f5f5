"""What an episode on the plant should cost from its start: by a twin, or by the linear model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.statistics import Logged, PlantEpisodes
from sb3_yann.twin.gradient import actor
from sb3_yann.twin.log import SHORTEST
from sb3_yann.twin.plant_twin import PlantTwin

STILL = 1e-6
"""A reference or disturbance that moves by less, in half-widths, does not move."""


@dataclass
class Recorder:
    """The thetas (n_theta,) and actions in [-1, 1] (m,) of one episode that is under way."""

    thetas: list[Array] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)

    def add(self, theta: Array, action: Array) -> None:
        """Note theta, and the action that is taken there."""
        self.thetas.append(np.asarray(theta, np.float32))
        self.actions.append(np.asarray(action, np.float32))

    def episode(self, problem: LinearMPC, last: Array) -> Logged:
        """Return the whole episode in the units of the problem, with its last theta."""
        low, high = problem.u_min, problem.u_max
        inputs = low + (np.array(self.actions) + 1) / 2 * (high - low)
        return np.array([*self.thetas, last], np.float32), inputs.astype(np.float32)


def predicted_cost(problem: LinearMPC, start: Array, steps: int) -> float:
    """Return what the MPC costs on its own linear model, from a start, over a number of steps."""
    law, theta, cost = problem.law(), start, 0.0
    for _ in range(steps):
        u = law(theta)
        cost += float(problem.stage_cost(theta, u))
        theta = problem.predict(theta, u)
    return cost


def predict_by_twin(
    session: GuardSession, candidate: PlantEpisodes, accepted: PlantEpisodes
) -> tuple[PlantEpisodes, PlantEpisodes, str]:
    """Return both with what the accepted policy costs in a twin of the plant, and who predicts.

    One twin is fitted to the episodes of both: it treats the two policies alike, so episodes of two
    equal policies stay exchangeable. Both stay as they are, predicted by the linear model, where no
    twin can be trusted, or where references or disturbances move within an episode.
    """
    given, problem = (candidate, accepted, "the linear model"), session.policy.problem
    log = [*candidate.log, *accepted.log]
    if len(log) < len(candidate.costs) + len(accepted.costs) or _moves(problem, log):
        return given
    seen = [each for each in log if len(each[1]) >= SHORTEST and np.all(np.isfinite(each[0]))]
    try:
        with np.errstate(all="ignore"), preserve_rng():
            twin = PlantTwin.fit(problem, seen, n_members=1)
    except ValueError:  # a log that cannot be read
        return given
    if not twin.trusted:
        return given
    costs = costs_in_twin(session, session.state.accepted, twin, log)
    if not np.all(np.isfinite(costs)):
        return given
    n = len(candidate.costs)
    both = replace(candidate, predicted=costs[:n]), replace(accepted, predicted=costs[n:])
    return *both, "the twin"


def costs_in_twin(
    session: GuardSession, checkpoint: ActorCheckpoint, twin: PlantTwin, log: Sequence[Logged]
) -> Array:
    """Return what a policy costs in a twin, from the start of each episode and over its length.

    Parameters
    ----------
    session : GuardSession
        The model under guard.
    checkpoint : ActorCheckpoint
        The policy that acts in the twin.
    twin : PlantTwin
        Its first member is played.
    log : sequence of Logged
        The episodes, of which starts and lengths are used.
    """
    with session.playing(checkpoint) as policy:
        layer = copy.deepcopy(policy.actor.mu).cpu()
    act = actor(layer, twin.problem)
    starts = np.array([[thetas[0] for thetas, _ in log]], np.float64)
    lengths = np.array([len(actions) for _, actions in log])
    with np.errstate(all="ignore"):
        thetas, inputs = twin.dynamics.roll_out(act, starts, int(lengths.max()))
        costs = twin.problem.stage_cost(thetas[:-1], inputs)[:, 0]
    return np.asarray(np.sum(costs, axis=0, where=np.arange(len(costs))[:, None] < lengths))


def _moves(problem: LinearMPC, log: Sequence[Logged]) -> bool:
    """Return whether a reference or a disturbance is not the same in all of an episode."""
    part = problem.layout.constant
    room = STILL * problem.theta_half[part]
    return any(bool(np.any(np.ptp(thetas[:, part], axis=0) > room)) for thetas, _ in log)
