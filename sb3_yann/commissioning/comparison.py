"""The plant against its twin: what a batch cost, was predicted to, and would with the MPC."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.commissioning.journal import Journal
from sb3_yann.commissioning.plant import Inputs, Plant, PlantEpisode
from sb3_yann.control import LinearMPC
from sb3_yann.twin.plant_twin import PlantTwin

Costs = tuple[float, float, float]
"""Mean costs of a batch: the plant's, as the twin had predicted, and what the MPC's would be."""


def compare(
    journal: Journal, plant: Plant, before: PlantTwin | None, now: PlantTwin | None
) -> Costs:
    """Return the mean costs of the present batch; NaN where there is no twin, or nothing quiet.

    The MPC's are those that the present twin predicts, and what its own episodes cost beyond that:
    with sensor noise a plant costs more than any twin without.

    Parameters
    ----------
    journal : Journal
        Its batch is compared.
    plant : Plant
        The policy that acted, and the MPC.
    before, now : PlantTwin, optional
        The twin that was in force, and the one that has learnt from the batch.
    """
    by_policy = any(each for _, each in journal.batch)
    quiet = [e for e, each in journal.batch if each == by_policy and e.alarm is None]
    if not quiet:
        return np.nan, np.nan, np.nan
    problem, act = plant.problem, plant.policy if by_policy else plant.mpc
    actual, predicted, mpc = float(_costs(problem, quiet).mean()), np.nan, np.nan
    if before is not None:
        predicted = float(predicted_costs(before, quiet, act).mean())
    if now is not None:
        length = np.mean([len(each.actions) for each in quiet])
        mpc = predicted_costs(now, quiet, plant.mpc).mean() + length * _beyond(journal, plant, now)
    return actual, predicted, float(mpc)


def _beyond(journal: Journal, plant: Plant, twin: PlantTwin) -> float:
    """Return how much more than in the twin a step of the MPC has cost."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    own = [each for each in own if each.alarm is None]
    if not own:
        return 0.0
    more = _costs(plant.problem, own) - predicted_costs(twin, own, plant.mpc)
    return float(more.sum() / sum(len(each.actions) for each in own))


def _costs(problem: LinearMPC, episodes: Sequence[PlantEpisode]) -> Array:
    cost = problem.stage_cost
    return np.array([np.sum(cost(each.thetas[:-1], each.actions)) for each in episodes])


def predicted_costs(twin: PlantTwin, episodes: Sequence[PlantEpisode], act: Inputs) -> Array:
    """Return what a policy would have cost from each episode's start, by the members' mean.

    References and disturbances are those of the episodes.
    """
    dynamics, constant = twin.dynamics, twin.problem.layout.constant
    lengths, members = np.array([len(each.actions) for each in episodes]), len(dynamics.members)
    theta = np.repeat(np.array([[each.thetas[0] for each in episodes]]), members, axis=0)
    shape, costs = theta.shape, np.zeros(theta.shape[:2])
    with np.errstate(all="ignore"):
        for k in range(lengths.max()):
            now = [each.thetas[min(k, last)] for each, last in zip(episodes, lengths, strict=True)]
            theta[..., constant] = np.array(now)[:, constant]
            u = act(theta.reshape(-1, shape[-1])).reshape(*shape[:2], -1)
            costs += np.where(k < lengths, twin.problem.stage_cost(theta, u), 0.0)
            theta = dynamics.step(theta, u)
    return np.asarray(costs.mean(axis=0))
