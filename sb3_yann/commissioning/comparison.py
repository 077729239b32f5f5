"""The plant against its twin: what a batch cost, was predicted to, and would with the MPC."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.commissioning.journal import Journal
from sb3_yann.commissioning.plant import Inputs, Plant, PlantEpisode
from sb3_yann.compare import allowed_excess
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import BoundExcess, bound_excess, excess_of_episodes
from sb3_yann.twin.plant_twin import PlantTwin

ENOUGH = 0.5
"""Of the gain that the twin promised, so much lets the bound of the correction grow."""
SURELY, MOST = 1.645, 0.05
"""Standard errors by which a policy's cost must be above the MPC's to be taken back, a one-sided
test of five per cent; what it may not exceed in any case, as a fraction of the MPC's cost."""
ALARMS = 0.25
"""Share of a policy's episodes with an alarm from which on it is taken back, two at least."""


class Costs(NamedTuple):
    """Mean costs of the episodes of the one that acted in a batch; NaN where nothing is known.

    Attributes
    ----------
    actual : float
        The plant's, episodes with an alarm included.
    predicted, promised : float
        What the twin had predicted, and how much less than for the MPC.
    mpc : float
        The MPC's from the same starts: what the twin that has learnt from them predicts, and what
        the MPC's own episodes cost beyond that. With sensor noise a plant costs more than any twin.
    error : float, default 0
        Standard error of ``actual - mpc``.
    longer : str, default ""
        By how much more than the MPC the policy exceeds hard bounds, summed over an episode.
    """

    actual: float
    predicted: float
    promised: float
    mpc: float
    error: float = 0.0
    longer: str = ""


def compare(
    journal: Journal, plant: Plant, before: PlantTwin | None, now: PlantTwin | None
) -> Costs:
    """Return the costs of the present batch.

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
    own = [e for e, each in journal.batch if each == by_policy and (by_policy or not e.alarm)]
    if not own:
        return Costs(np.nan, np.nan, np.nan, np.nan)
    problem, act = plant.problem, plant.policy if by_policy else plant.mpc
    predicted = promised = mpc = np.nan
    error, actual = 0.0, _costs(problem, own)
    if before is not None:
        predicted = predicted_costs(before, own, act).mean()
        promised = predicted_costs(before, own, plant.mpc).mean() - predicted
    if now is not None:
        length = np.mean([len(each.actions) for each in own])
        as_mpc = predicted_costs(now, own, plant.mpc)
        beyond, unsure = _beyond(journal, plant, now)
        mpc = as_mpc.mean() + length * beyond
        error = np.hypot(_standard_error(actual - as_mpc), length * unsure)
    shown = map(float, (actual.mean(), predicted, promised, mpc, error))
    return Costs(*shown, _longer(journal, problem, own) if by_policy else "")


def why_taken_back(journal: Journal, costs: Costs) -> str:
    """Return what the plant says against the policy of the present batch; empty if nothing."""
    played = [each for each, by_policy in journal.batch if by_policy]
    if journal.cut_off >= 2:
        return f"{journal.cut_off} episodes that it began never ended"
    if not played:
        return ""
    if unsafe := sum(each.violations for each in played):
        return f"it violated a limit in {unsafe} steps"
    if costs.longer:
        return costs.longer
    alarms = sum(each.alarm is not None for each in played)
    if alarms >= max(2.0, ALARMS * len(played)):
        return f"{alarms} of its {len(played)} episodes had an alarm"
    room = min(SURELY * costs.error, MOST * abs(costs.mpc))
    if not costs.actual <= costs.mpc + room < np.inf:  # nor does NaN pass
        return f"it cost {costs.actual:.5g}, the MPC would have {costs.mpc:.5g}"
    return ""


def excess_of_mpc(journal: Journal, problem: LinearMPC) -> BoundExcess:
    """Return the excess over the bounds of the MPC's own episodes in the log, one 0 without any."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    if not own:
        return BoundExcess(*np.zeros((4, 1)))
    return excess_of_episodes(problem, ((each.thetas, each.actions) for each in own))


def _longer(journal: Journal, problem: LinearMPC, played: Sequence[PlantEpisode]) -> str:
    mpc = excess_of_mpc(journal, problem)
    ours = excess_of_episodes(problem, ((each.thetas, each.actions) for each in played))
    summed, before = float(ours.summed.mean()), float(mpc.summed.mean())
    if summed <= allowed_excess(before) + mpc.largest.max():
        return ""
    return (
        f"it exceeded hard bounds by {summed:.3g} half-widths, summed over an episode, the MPC by "
        f"{before:.3g}"
    )


def is_confirmed(journal: Journal, costs: Costs) -> bool:
    """Return whether the plant gave at least half of what the twin had promised, without alarm."""
    quiet = not any(each.alarm for each, by_policy in journal.batch if by_policy)
    gained = costs.mpc - costs.actual
    return quiet and 0 < ENOUGH * costs.promised <= gained < np.inf


def _beyond(journal: Journal, plant: Plant, twin: PlantTwin) -> tuple[float, float]:
    """Return how much more than in the twin a step of the MPC has cost, and the standard error."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    own = [each for each in own if each.alarm is None]
    if not own:
        return 0.0, 0.0
    more = _costs(plant.problem, own) - predicted_costs(twin, own, plant.mpc)
    steps = sum(len(each.actions) for each in own)
    return float(more.sum() / steps), len(own) * _standard_error(more) / steps


def _standard_error(values: Array) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def _costs(problem: LinearMPC, episodes: Sequence[PlantEpisode]) -> Array:
    cost = problem.stage_cost
    stage = np.array([np.sum(cost(each.thetas[:-1], each.actions)) for each in episodes])
    soft = excess_of_episodes(problem, ((each.thetas, each.actions) for each in episodes))
    return np.asarray(stage + soft.penalty)


def predicted_costs(twin: PlantTwin, episodes: Sequence[PlantEpisode], act: Inputs) -> Array:
    """Return what a policy would have cost from each episode's start, by the members' mean.

    References and measured disturbances are those of the episodes.
    """
    dynamics, row = twin.dynamics, twin.dynamics.row
    lengths, members = np.array([len(each.actions) for each in episodes]), len(dynamics.members)
    first = row.begin(np.array([[each.thetas[0] for each in episodes]]))
    theta = np.repeat(first, members, axis=0)
    shape, costs = theta.shape, np.zeros(theta.shape[:2])
    with np.errstate(all="ignore"):
        for k in range(lengths.max()):
            now = [each.thetas[min(k, last)] for each, last in zip(episodes, lengths, strict=True)]
            theta[..., row.given] = np.array(now)[:, row.given]
            u = act(row.shown(theta.reshape(-1, shape[-1]))).reshape(*shape[:2], -1)
            costs += np.where(k < lengths, twin.problem.stage_cost(row.shown(theta), u), 0.0)
            after = dynamics.step(theta, u)
            reached = np.array([row.shown(theta), row.shown(after)])
            soft = bound_excess(twin.problem, reached, u[None]).penalty
            costs += np.where(k < lengths, soft, 0.0)
            theta = after
    return np.asarray(costs.mean(axis=0))
