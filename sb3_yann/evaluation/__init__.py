"""Seeded episodes, what they cost before and after training, and pictures."""

from __future__ import annotations

from sb3_yann.compare import paired_rows, summary_lines
from sb3_yann.rollout import Trajectories, as_played, evaluate

__all__ = ["Trajectories", "comparison_table", "evaluate"]
MAX_ROWS = 20  # episodes that have a row each, at most


def comparison_table(title: str, before: Trajectories, after: Trajectories) -> str:
    """Return what the same episodes cost with the MPC and after training, to be printed.

    The last rows are those of :meth:`Improvement.report`; above them each episode has a row, where
    there are no more than twenty. The episodes must be those of the same seeds.

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
    if counts[0] <= MAX_ROWS:
        lines.append(f"  {'episode':<13}{'MPC':>12}{'after':>12}{'change':>12}")
        for number, (old, new) in enumerate(zip(before.costs, after.costs, strict=True), start=1):
            lines.append(f"  {number:<13}{old:>12,.2f}{new:>12,.2f}{new - old:>+12,.2f}")
    violations = f"{after.violations.sum()} steps, {before.violations.sum()} with the MPC"
    return summary_lines(
        "\n".join(lines), **paired_rows(after.costs, before.costs), violations=violations
    )
