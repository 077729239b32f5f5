"""What a batch cost on the plant, with policy and MPC in turns, and what was predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.commissioning.journal import Journal
from sb3_yann.commissioning.plant import Inputs, Plant, PlantEpisode
from sb3_yann.compare import Difference, allowed_excess
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import (
    BoundExcess,
    BoundNames,
    bound_excess,
    excess_of_episodes,
)
from sb3_yann.twin.plant_twin import PlantTwin

ENOUGH = 0.5
"""Of the gain that the twin promised, so much lets the bound of the correction grow."""
MOST = 0.05
"""What a policy may cost more than the MPC in any case, as a fraction of the MPC's cost."""
OWN = 0.95
"""Share of the episodes' rewards that the stage cost explains where they are the same."""
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
        What the plant showed of the MPC, which took turns with the policy.
    more : float, default nan
        What the policy cost more, over pairs of episodes, less what the twin says that their starts
        differ by.
    error : float, default 0
        Its standard error, widened where pairs that follow each other are correlated.
    pairs : int, default 0
        Episodes of the policy that have one of the MPC beside them.
    own_reward : bool, default False
        Whether the costs are minus the rewards, which are not the stage cost: a twin, whose costs
        are stage costs, promises nothing then.
    longer : str, default ""
        By how much more than the MPC the policy exceeds hard bounds, summed over an episode.
    chance : float, default 0
        How often the order that was drawn for each of few pairs alone brings a mean as low.
    """

    actual: float
    predicted: float
    promised: float
    mpc: float
    more: float = np.nan
    error: float = 0.0
    pairs: int = 0
    own_reward: bool = False
    longer: str = ""
    chance: float = 0.0

    @property
    def difference(self) -> Difference:
        """The policy's cost less the MPC's."""
        return Difference(self.more, self.error, self.pairs, self.chance)


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
    of_mpc = [each for each, policys in journal.batch if not policys and each.alarm is None]
    own = [each for each, policys in journal.batch if policys] if by_policy else of_mpc
    if not own:
        return Costs(np.nan, np.nan, np.nan, np.nan)
    pays_own, problem = pays_its_own(plant.problem, journal.episodes), plant.problem
    actual, predicted, promised = _costs(problem, own, pays_own), np.nan, np.nan
    if before is not None and not pays_own:
        as_mpc = predicted_costs(before, own, plant.mpc)
        told = predicted_costs(before, own, plant.policy) if by_policy else as_mpc
        predicted, promised = float(told.mean()), float(as_mpc.mean() - told.mean())
    mean, pairs = float(actual.mean()), min(len(own), len(of_mpc))
    if not by_policy:
        return Costs(mean, predicted, promised, mean, own_reward=pays_own)
    longer = _longer(journal, problem, own)
    if not pairs:
        return Costs(mean, predicted, promised, np.nan, own_reward=pays_own, longer=longer)
    mpc = _costs(problem, of_mpc, pays_own)
    more = actual[:pairs] - mpc[:pairs]
    if now is not None and not pays_own:
        starts = [predicted_costs(now, each[:pairs], plant.mpc) for each in (own, of_mpc)]
        more = more - (starts[0] - starts[1])
    found = Difference.of(more, in_turns=True)
    return Costs(
        actual=mean,
        predicted=predicted,
        promised=promised,
        mpc=float(mpc.mean()),
        more=found.mean,
        error=found.error,
        pairs=pairs,
        own_reward=pays_own,
        longer=longer,
        chance=found.chance,
    )


def pays_its_own(problem: LinearMPC, episodes: Sequence[PlantEpisode]) -> bool:
    """Return whether the episodes' rewards are something else than minus their stage costs.

    They may differ by a constant and a factor. Rewards that are all zero are none.
    """
    rewards = np.array([each.reward for each in episodes])
    if not np.all(np.isfinite(rewards)) or not np.any(rewards):
        return False
    costs = _costs(problem, episodes, False)
    spread = float(np.std(rewards) * np.std(costs))
    if not spread > 1e-9 * np.abs(rewards).max() * np.abs(costs).max():
        return False
    correlation = -float(np.mean((rewards - rewards.mean()) * (costs - costs.mean()))) / spread
    return not (correlation > 0 and correlation**2 >= OWN)


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
    room = min(costs.difference.room(0.05), MOST * abs(costs.mpc))
    if not costs.more <= room < np.inf:  # nor does NaN pass
        by = "by the plant's reward, " if costs.own_reward else ""
        return f"{by}it cost {costs.actual:.5g}, the MPC in turns with it {costs.mpc:.5g}"
    return ""


def is_kept(costs: Costs) -> bool:
    """Return whether the plant has shown that the policy surely costs less than the MPC."""
    return costs.difference.is_below_zero(0.05)


def excess_of_mpc(journal: Journal, problem: LinearMPC) -> BoundExcess:
    """Return the excess over the bounds of the MPC's own episodes in the log, one 0 without any."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    if not own:
        return BoundExcess(*np.zeros((5, 1)))
    return excess_of_episodes(problem, ((each.thetas, each.actions) for each in own))


def _longer(journal: Journal, problem: LinearMPC, played: Sequence[PlantEpisode]) -> str:
    mpc = excess_of_mpc(journal, problem)
    ours = excess_of_episodes(problem, ((each.thetas, each.actions) for each in played))
    summed, before = float(ours.summed.mean()), float(mpc.summed.mean())
    if summed <= allowed_excess(before) + mpc.largest.max():
        return ""
    most = int(np.argmax(ours.largest))
    words = BoundNames.of(problem).in_words(np.asarray(ours.worst)[most], ours.largest[most])
    return (
        f"it exceeded hard bounds by {summed:.3g} half-widths, summed over an episode, the MPC by "
        f"{before:.3g}: {words}"
    )


def is_confirmed(journal: Journal, costs: Costs) -> bool:
    """Return whether the plant gave at least half of what the twin had promised, without alarm."""
    quiet = not any(each.alarm for each, by_policy in journal.batch if by_policy)
    gained = -costs.more
    return quiet and 0 < ENOUGH * costs.promised <= gained < np.inf


def _costs(problem: LinearMPC, episodes: Sequence[PlantEpisode], own_reward: bool) -> Array:
    if own_reward:
        return np.array([-each.reward for each in episodes])
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
            costs += np.where(
                k < lengths, twin.problem.deviations.stage_cost(row.shown(theta), u), 0.0
            )
            after = dynamics.step(theta, u)
            reached = np.array([row.shown(theta), row.shown(after)])
            soft = bound_excess(twin.problem, reached, u[None]).penalty
            costs += np.where(k < lengths, soft, 0.0)
            theta = after
    return np.asarray(costs.mean(axis=0))
