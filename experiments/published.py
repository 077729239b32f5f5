"""What the paper prints of its two plants, beside the same averages here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from experiments.markdown import number, table
from experiments.measures import OURS, plants_of
from experiments.runner import Outcome, Run

TESTS = 10
"""Test episodes that the paper averages."""
HEADER = ("plant", "learner", "before", "after", "paper, before", "paper, after")
REPORTED: dict[str, dict[str, tuple[str, str]]] = {
    "CSTR": {
        "DDPG, best start": ("800.24", "664.39"),
        "DDPG, worst start": ("> 3e4", "603.78"),
        OURS: ("94.32", "92.22"),
    },
    "pendulum": {"DDPG": ("1,586.97", "28.42"), OURS: ("270.99", "26.08")},
}
"""The paper's averages, initial and final."""


def paper_table(outcomes: Mapping[Run, Outcome], episodes: int) -> str:
    """Return the averages over the first ten test episodes; empty where no run is there."""
    rows = [
        [plant, name, *averages(outcome), *REPORTED[kind][name]]
        for plant in plants_of(outcomes)
        if (kind := _kind_of(plant))
        for name, outcome in _learners(outcomes, plant, kind, episodes)
    ]
    return table(HEADER, rows, texts=2) if rows else ""


def averages(outcome: Outcome) -> list[str]:
    """Return the mean costs of the first test episodes, before and after training."""
    return [number(float(costs[:TESTS].mean())) for costs in outcome.test_costs[[0, -1]]]


def _kind_of(plant: str) -> str:
    if plant.startswith("pendulum"):
        return "pendulum"
    return plant if plant in REPORTED else ""


def _learners(
    outcomes: Mapping[Run, Outcome], plant: str, kind: str, episodes: int
) -> Iterator[tuple[str, Outcome]]:
    """Yield DDPG, on the reactor its best and its worst start, and ours with the first seed."""
    found: dict[str, dict[int, Outcome]] = {"DDPG": {}, OURS: {}}
    for run, outcome in outcomes.items():
        if run.plant == plant and run.learner in found and episodes in outcome.checkpoints:
            found[run.learner][run.seed] = outcome.at(episodes)
    plain = found["DDPG"]
    ours = found[OURS]
    if plain and kind == "CSTR":
        order = sorted(plain.values(), key=lambda each: float(each.test_costs[0, :TESTS].mean()))
        yield "DDPG, best start", order[0]
        yield "DDPG, worst start", order[-1]
    elif plain:
        yield "DDPG", plain[min(plain)]
    if ours:
        yield OURS, ours[min(ours)]
