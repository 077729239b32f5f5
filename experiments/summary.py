"""The few rows that the README quotes, and how they get there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from experiments.markdown import number, table
from experiments.measures import MPC, OPTIMUM, OURS, Row, plants_of, standing
from experiments.runner import Outcome, Run

SHOWN = (
    OPTIMUM,
    MPC,
    OURS,
    f"{OURS}, guard off",
    "residual RL",
    "cloned MPC, then DDPG",
    "DDPG",
    "DDPG, best kept",
)
HEADER = (
    "learner",
    "seeds",
    "mean cost, median (range)",
    "worst start against the MPC",
    "excess cost of learning",
    "training episodes with violation",
)
BEGIN, END = "<!-- results: begin -->\n", "<!-- results: end -->"


def summary(outcomes: Mapping[Run, Outcome], episodes: int) -> str:
    """Return a table of the best known learners for each plant, in Markdown."""
    parts = []
    for plant in plants_of(outcomes):
        at = standing(outcomes, plant, episodes)
        rows = [_cells(at.row(name)) for name in SHOWN if name in at.learners]
        if OURS in at.learners:
            parts.append(f"**{plant}**\n\n{table(HEADER, rows)}")
    return "\n\n".join(parts)


def quote(text: str, readme: Path, first: str = BEGIN, last: str = END) -> bool:
    """Put the text between the marks of a README; return whether it has them."""
    old = readme.read_text(encoding="utf-8") if readme.exists() else ""
    before, begin, rest = old.partition(first)
    _, end, after = rest.partition(last)
    if not (begin and end):
        return False
    readme.write_text(f"{before}{first}\n{text}\n\n{last}{after}", encoding="utf-8")
    return True


def _cells(row: Row) -> list[str]:
    learnt = row.excess is not None
    mean = number(row.median)
    if row.seeds > 1:
        mean += f" ({number(row.low)} to {number(row.high)})"
    excess = ""
    if row.excess is not None:
        median, low, high = (number(value, 0, "+") for value in row.excess)
        excess = f"{median} ({low} to {high})"
    return [
        f"**{OURS}**" if row.learner == OURS else row.learner,
        str(row.seeds) if learnt else "",
        mean,
        number(row.worst, sign="+") if learnt else "",
        excess,
        str(row.unsafe_training) if learnt else "",
    ]
