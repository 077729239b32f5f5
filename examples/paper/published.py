"""The paper's two tables in its own form: ten test episodes, before and after training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from paper.measures import OURS
from paper.runner import Outcome, Run

TESTS = 10
REPORTED = {
    "CSTR": {
        "DDPG-G": ("1", "800.24", "664.39"),
        "DDPG-P": ("9", "> 3e4", "603.78"),
        OURS: ("0", "94.32", "92.22", "-2.10"),
    },
    "pendulum": {
        "DDPG": ("", "1,586.97", "28.42"),
        OURS: ("", "270.99", "26.08", "-244.91"),
    },
}
"""Safety violations, and the averages: initial, final, change."""


def paper_table(outcomes: Mapping[Run, Outcome], plant: str, episodes: int) -> str:
    """Return the table of one plant, or nothing where the paper has none or no run is there."""
    kind = plant if plant == "CSTR" else plant.partition(",")[0]
    reported = REPORTED.get(kind, {}) if plant != "CSTR, true model" else {}
    columns = [
        (name, _ten(outcome, episodes), reported[name])
        for name, outcome in _chosen(outcomes, plant, episodes).items()
        if name in reported
    ]
    if not columns:
        return ""
    header = ["episode"]
    for name, costs, _ in columns:
        header += [f"{name} {part}" for part in ("initial", "final", "change")[: len(costs)]]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    if kind == "CSTR":
        lines.append(["safety violations in training", *_violations(outcomes, plant, columns)])
    for k in range(min(TESTS, columns[0][1].shape[1])):
        lines.append([str(k + 1), *(cell for _, costs, _ in columns for cell in _cells(costs[:, k]))])
    averages = [cell for _, costs, _ in columns for cell in _cells(costs.mean(axis=1))]
    lines.append(["**average**", *averages])
    lines.append(["average in the paper", *(c for *_, paper in columns for c in paper[1:])])
    return f"### {plant}: cost of each test episode\n\n" + _joined(lines) + _note(kind, episodes)
