"""A log that holds a measured disturbance, or an observer's, teaches, and its table is honest."""

from __future__ import annotations

import numpy as np
import pytest

from experiments import headroom as plants
from experiments import tank_disturbed
from experiments.tank_disturbed import HEADER, Case, measured, observed, rows
from sb3_yann.evaluation import evaluate


def test_the_logs_are_of_other_starts_than_the_tests() -> None:
    logs = {100_000 + 100 * seed + n for seed in tank_disturbed.SEEDS for n in range(50)}
    assert logs.isdisjoint(tank_disturbed.TEST_SEEDS)
    assert len(logs) == 50 * len(tank_disturbed.SEEDS)


def test_the_observer_leaves_no_offset_where_the_mpc_alone_does() -> None:
    def error(case: plants.Case | Case) -> float:
        shown = evaluate(case.mpc.explicit(), case[1], range(3)).observations
        reference = case.mpc.layout.reference
        # The step before the set-point changes.
        ends = [np.abs(s[19, :2] - s[19, reference]).mean() for s in shown]
        return float(np.mean(ends))

    assert error(observed()) < 0.02  # cm
    assert error(plants.worn_tank()) > 0.2
    assert measured().observer is None


def test_a_row_compares_with_the_mpc_on_the_same_starts(monkeypatch) -> None:
    def run(case: Case, episodes: int, seed: int):
        return True, base * (0.9 if seed % 2 else 1.2)

    case = measured()
    monkeypatch.setattr(tank_disturbed, "TEST_SEEDS", range(3))
    monkeypatch.setattr(tank_disturbed, "SEEDS", range(2))
    monkeypatch.setattr(tank_disturbed, "EPISODES", (5,))
    monkeypatch.setattr(tank_disturbed, "run", run)
    base = evaluate(case.mpc.explicit(), case.make, range(3)).costs
    (row,) = rows("the plant", case)
    shown = dict(zip(HEADER, row, strict=True))
    assert shown["`improve`, %"] == "+5.00 (-10.00 to +20.00)"
    assert float(shown["worst start, %"]) == pytest.approx(20 * base.max() / base.mean(), abs=0.01)
    assert float(shown["headroom, %"]) < 0
    assert shown["accepted"] == "2 of 2"
