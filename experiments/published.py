"""The paper's two tables in its own form: ten test episodes, before and after training."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.markdown import number, table
from experiments.measures import OURS
from experiments.runner import Outcome, Run

TESTS = 10
REPORTED: dict[str, dict[str, tuple[str, ...]]] = {
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
"""What the paper reports: safety violations; and the averages, initial, final and change."""


@dataclass(frozen=True)
class Column:
    """One learner of a table.

    Attributes
    ----------
    name : str
    seed : int
    outcome : Outcome
    reported : tuple of str
        The paper's violations and averages.
    """

    name: str
    seed: int
    outcome: Outcome
    reported: tuple[str, ...]

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the names of the columns below the learner's."""
        return ("initial", "final", "change")[: len(self.reported) - 1]

    @property
    def costs(self) -> NDArray[np.float64]:
        """Return the costs of the first ten test episodes, shape (parts, episodes)."""
        initial, final = self.outcome.test_costs[[0, -1], :TESTS]
        return np.array([initial, final, final - initial])[: len(self.parts)]

    def cells(self, costs: NDArray[np.float64]) -> list[str]:
        """Return one row's cells: the change has a sign."""
        signs = ["+" if part == "change" else "" for part in self.parts]
        return [number(cost, sign=sign) for cost, sign in zip(costs, signs, strict=True)]


def paper_table(outcomes: Mapping[Run, Outcome], plant: str, episodes: int) -> str:
    """Return the table of one plant; empty where the paper has none, or where no run is there."""
    kind = "CSTR" if plant == "CSTR" else "pendulum" if plant.startswith("pendulum") else ""
    columns = [*_columns(outcomes, plant, kind, episodes)] if kind else []
    if not columns:
        return ""
    header = ["episode", *(f"{c.name} {part}" for c in columns for part in c.parts)]
    rows = []
    if kind == "CSTR":
        unsafe = [str(int((c.outcome.training_violations > 0).sum())) for c in columns]
        rows.append(["safety violations in training", *_spread(columns, unsafe)])
        rows.append(["in the paper", *_spread(columns, [c.reported[0] for c in columns])])
    for k in range(columns[0].costs.shape[1]):
        rows.append([str(k + 1), *(cell for c in columns for cell in c.cells(c.costs[:, k]))])
    averages = [cell for c in columns for cell in c.cells(c.costs.mean(axis=1))]
    rows.append(["**average**", *(f"**{cell}**" for cell in averages)])
    rows.append(["average in the paper", *(cell for c in columns for cell in c.reported[1:])])
    seeds = ", ".join(f"{column.name}: seed {column.seed}" for column in columns)
    return (
        f"### {plant}, cost of the first ten test episodes\n\nBefore and after {episodes} training "
        f"episodes; {seeds}. The paper's starts are not known, hence only averages are set beside."
        f"\n\n{table(header, rows)}"
    )


def _spread(columns: list[Column], cells: list[str]) -> list[str]:
    """Return one cell for each learner, with empty ones below the rest of its columns."""
    pairs = zip(columns, cells, strict=True)
    return [text for c, cell in pairs for text in (cell, *[""] * (len(c.parts) - 1))]


def _columns(
    outcomes: Mapping[Run, Outcome], plant: str, kind: str, episodes: int
) -> Iterator[Column]:
    """Yield DDPG, on the reactor its best and its worst beginning, and ours with the first seed."""
    found: dict[str, dict[int, Outcome]] = {"DDPG": {}, OURS: {}}
    for run, outcome in outcomes.items():
        if run.plant == plant and run.learner in found and episodes in outcome.checkpoints:
            found[run.learner][run.seed] = outcome.at(episodes)
    plain, ours, reported = found["DDPG"], found[OURS], REPORTED[kind]
    order = sorted(plain, key=lambda seed: float(plain[seed].test_costs[0, :TESTS].mean()))
    chosen = {"DDPG": min(plain)} if plain else {}
    if plain and kind == "CSTR":
        chosen = {"DDPG-G": order[0], "DDPG-P": order[-1]}
    for name, seed in chosen.items():
        yield Column(name, seed, plain[seed], reported[name])
    if ours:
        yield Column(OURS, min(ours), ours[min(ours)], reported[OURS])
