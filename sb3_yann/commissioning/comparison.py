"""What a batch cost on the plant, with policy and MPC in turns, and what was predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.commissioning.journal import Journal
from sb3_yann.commissioning.plant import Inputs, Plant, PlantEpisode
from sb3_yann.compare import Difference, allowed_excess, level_of_look, paired_rows
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import (
    BoundExcess,
    BoundNames,
    bound_excess,
    excess_of_episodes,
)
from sb3_yann.improvement.confirmation import RULE
from sb3_yann.twin.plant_twin import PlantTwin

PAIRS_TO_GIVE_UP = 10  # so many that show no gain end a trial
MOST_ABOVE_MPC = 0.05  # of the MPC's cost: what a policy may cost more in any case
SAME_REWARD = 0.95  # share of the episodes' rewards that the same stage cost explains
ALARMS = 0.25
"""Share of a policy's episodes with an alarm from which on it is taken back, two at least."""


class Costs(NamedTuple):
    """What the plant has shown; NaN where nothing is known.

    ``actual`` is the mean cost of the episodes of the one that acted in the batch, those with an
    alarm included, ``predicted`` what the twin had predicted of them, ``mpc`` what the MPC cost in
    turns with the policy. ``difference`` is of all pairs since the policy is on trial, in the order
    in which they were played; ``look`` counts the looks at it. With ``own_reward`` costs
    are minus the rewards, which are not the stage cost: no twin knows them. ``longer`` says by how
    much more than the MPC the policy exceeds hard bounds, summed over an episode.
    """

    actual: float = np.nan
    predicted: float = np.nan
    mpc: float = np.nan
    difference: Difference = Difference(np.nan, np.inf, 0)
    look: int = 1
    own_reward: bool = False
    longer: str = ""


def compare(
    journal: Journal, plant: Plant, before: PlantTwin | None, now: PlantTwin | None
) -> Costs:
    """Return what the present batch cost, and all pairs of the policy that is on trial.

    A plant does not repeat a start. Which of a pair plays first is drawn, so their starts differ by
    nothing on average, and so does what a twin says that the MPC costs from them: it is a control
    variate, taken where the differences vary less with it. It biases nothing, however wrong. The
    twin ``before`` was in force, ``now`` is the one that has learnt from the batch.
    """
    problem = plant.problem
    by_policy = any(each for _, each in journal.batch)
    quiet = [each for each, own in journal.batch if not own and not each.alarm and not each.excited]
    acted = [each for each, own in journal.batch if own] if by_policy else quiet
    if not acted:
        return Costs()
    pays_own = pays_its_own(problem, journal.episodes)
    predicted = np.nan
    actual = float(_costs(problem, acted, pays_own).mean())
    if before is not None and not pays_own:
        act = plant.policy if by_policy else plant.mpc
        predicted = float(predicted_costs(before, acted, act).mean())
    mpc = float(_costs(problem, quiet, pays_own).mean()) if quiet else np.nan
    if not by_policy:
        return Costs(actual, predicted, mpc, own_reward=pays_own)
    found = Costs(actual, predicted, mpc, look=len(journal.trial), own_reward=pays_own)
    found = found._replace(longer=_longer(journal, problem, acted))
    pairs = journal.pairs
    if not pairs:
        return found
    ours, its = zip(*pairs, strict=True)
    more = _costs(problem, ours, pays_own) - _costs(problem, its, pays_own)
    if now is not None and not pays_own:
        starts = [predicted_costs(now, each, plant.mpc) for each in (ours, its)]
        varied = more - (starts[0] - starts[1])
        more = varied if np.isfinite(varied).all() and varied.std() < more.std() else more
    return found._replace(difference=Difference.of(more, in_turns=True))


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
    return not (correlation > 0 and correlation**2 >= SAME_REWARD)


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
    if not costs.difference.pairs:
        return "no pair of episodes shows what it costs"
    more = costs.difference.mean
    room = costs.difference.room(RULE.significance)
    if not more <= min(room, MOST_ABOVE_MPC * abs(costs.mpc)):  # nor does NaN pass
        by = "by the plant's reward, " if costs.own_reward else ""
        return f"{by}it cost {costs.actual:.5g}, the MPC in turns with it {costs.mpc:.5g}"
    if is_hopeless(costs):
        return f"{costs.difference.pairs} pairs show no gain"
    return ""


def rows_of_pairs(journal: Journal, problem: LinearMPC) -> dict[str, str]:
    """Return what the pairs of the policy on trial cost, in words; the interval has all looks."""
    if not journal.pairs:
        return {"change": "no pair of episodes has been played yet"}
    pays_own = pays_its_own(problem, journal.episodes)
    ours, its = (_costs(problem, each, pays_own) for each in zip(*journal.pairs, strict=True))
    level = level_of_look(RULE.significance, len(journal.trial))
    return paired_rows(ours, its, level=level, in_turns=True)


def is_kept(costs: Costs) -> bool:
    """Return whether the plant has shown that the policy surely costs less than the MPC.

    All looks at a policy together err with a probability of 5 % at most.
    """
    return costs.difference.is_below_zero(level_of_look(RULE.significance, costs.look))


def is_hopeless(costs: Costs) -> bool:
    """Return whether more pairs would hardly show a gain that counts."""
    least = RULE.least_gain * abs(costs.mpc)
    more = costs.difference
    return more.pairs >= PAIRS_TO_GIVE_UP and more.is_hopeless(least)


def excess_of_mpc(journal: Journal, problem: LinearMPC) -> BoundExcess:
    """Return the excess over the bounds of the MPC's own episodes in the log, one 0 without any."""
    own = [journal.episodes[i] for i in journal.log if not journal.by_policy[i]]
    own = [each for each in own if not each.excited]
    if not own:
        return BoundExcess(*np.zeros((5, 1)))
    return excess_of_episodes(problem, ((each.thetas, each.actions) for each in own))


def _longer(journal: Journal, problem: LinearMPC, played: Sequence[PlantEpisode]) -> str:
    mpc = excess_of_mpc(journal, problem)
    ours = excess_of_episodes(problem, ((each.thetas, each.actions) for each in played))
    summed = float(ours.summed.mean())
    before = float(mpc.summed.mean())
    if summed <= allowed_excess(before) + mpc.largest.max():
        return ""
    most = int(np.argmax(ours.largest))
    words = BoundNames.of(problem).in_words(np.asarray(ours.worst)[most], ours.largest[most])
    return (
        f"it exceeded hard bounds by {summed:.3g} half-widths, summed over an episode, the MPC by "
        f"{before:.3g}: {words}"
    )


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
    dynamics = twin.dynamics
    row = twin.dynamics.row
    problem = twin.problem
    lengths = np.array([len(each.actions) for each in episodes])
    steps = np.arange(lengths.max())[:, None]
    first = row.begin(np.array([each.thetas[0] for each in episodes]))
    given = np.stack([e.thetas[np.minimum(steps[:, 0], len(e.actions))] for e in episodes], axis=1)
    starts = np.repeat(first[None], len(dynamics.members), axis=0)
    with np.errstate(all="ignore"):
        rows, u = dynamics.roll_out(act, starts, len(steps), given[..., row.given])
        costs = np.asarray(problem.deviations.stage_cost(row.shown(rows[:-1]), u))
        found = np.sum(costs * (steps < lengths)[:, None], axis=0)
        for i, length in enumerate(lengths):
            played = row.shown(rows[: length + 1, :, i])
            found[:, i] += bound_excess(problem, played, u[:length, :, i]).penalty
    return np.asarray(found.mean(axis=0))
