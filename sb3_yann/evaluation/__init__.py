"""Seeded episodes, what they cost before and after training as it is printed, and pictures."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.compare import Difference
from sb3_yann.rollout import Trajectories, as_played, evaluate

__all__ = ["Trajectories", "comparison_table", "evaluate"]


def comparison_table(
    title: str,
    before: Trajectories,
    after: Trajectories,
    *,
    names: tuple[str, str] = ("MPC", "after"),
) -> str:
    """Return what the same episodes cost with the MPC and after training, to be printed.

    The last rows are those of :meth:`Improvement.report`; above them each episode has a row, where
    there are no more than twenty.

    Parameters
    ----------
    title : str
        The first line.
    before, after : Trajectories
        Of the same seeds.
    names : tuple of two str
        What was played before and after, for the heads of the columns.

    Examples
    --------
    >>> from sb3_yann.evaluation import evaluate
    >>> none, full = (evaluate(lambda _, u=u: [u], "CSTR-v0", [0, 1]) for u in (0.0, 1.0))
    >>> len(comparison_table("no input, full input", none, full).splitlines())
    7
    """
    counts = [len(as_played(*each).costs) for each in (("before", before), ("after", after))]
    if counts[0] != counts[1] or not counts[0]:
        raise ValueError(
            f"before has {counts[0]} episodes and after {counts[1]}; they must be those of the "
            "same seeds, one at least. Pass both what evaluate returns for these seeds."
        )
    lines = [title]
    if counts[0] <= 20:  # episodes that have a row each, at most
        lines.append(f"  {'episode':<13}{names[0]:>12}{names[1]:>12}{'change':>12}")
        for number, (old, new) in enumerate(zip(before.costs, after.costs, strict=True), start=1):
            lines.append(f"  {number:<13}{old:>12,.2f}{new:>12,.2f}{new - old:>+12,.2f}")
    violations = f"{after.violations.sum()} steps, {names[0]} {before.violations.sum()}"
    ended = f"{after.terminated.sum()} by the env before their time, {names[0]} "
    ended += f"{before.terminated.sum()}: their costs are of fewer steps"
    old, new = (each.observations[0].shape[-1] for each in (before, after))
    paid = [float(np.sum(each.penalty)) / counts[0] for each in (after, before)]
    soft = f"{paid[0]:.5g} instead of {paid[1]:.5g} an episode, which is in no cost above"
    other = f"observations have {old} and {new} entries: rewards may be of different costs"
    return summary_lines(
        "\n".join(lines),
        **paired_rows(after.costs, before.costs),
        violations=violations,
        ended=ended * bool(after.terminated.any() or before.terminated.any()),
        soft_bounds=soft * any(paid),
        note=other * (old != new),
    )


def summary_lines(verdict: str, **rows: str) -> str:
    """Return a verdict and what it rests on, one row each; rows without text are left out.

    `improve`, `headroom`, the guard and commissioning all print the same rows, in the same order:
    change, worst start, violations, steps, next.
    """
    shown = (f"  {name.replace('_', ' '):<13}{text}" for name, text in rows.items() if text)
    return "\n".join([verdict, *shown])


def change_in_percent(change: float, interval: tuple[float, float] | None = None) -> str:
    """Return a change relative to the MPC's cost in %, with its interval of 90 %."""
    change, *ends = (round(100 * each, 2) + 0.0 for each in (change, *(interval or ())))  # no -0.00
    known = len(ends) == 2 and np.all(np.isfinite(ends))
    return f"{change:+.2f} %" + (f" ({ends[0]:+.2f} to {ends[1]:+.2f} %, 90 %)" if known else "")


def paired_rows(
    costs: Array, mpc: Array, *, level: float = 0.05, in_turns: bool = False
) -> dict[str, str]:
    """Return the rows `change` and `worst_start` of costs from the same starts as the MPC's."""
    change = f"{costs.mean():.5g} instead of {mpc.mean():.5g} over {len(costs)} episodes"
    size = float(np.abs(mpc).mean())
    if not (size and np.isfinite(size)):
        return {"change": change}
    found = Difference.relative(costs - mpc, mpc, in_turns=in_turns)
    room = found.room(level)
    shown = change_in_percent(found.mean, (found.mean - room, found.mean + room))
    return {
        "change": f"{shown}; {change}",
        "worst_start": f"{change_in_percent((costs - mpc).max() / size)} of the MPC's mean cost",
    }
