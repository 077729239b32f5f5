"""The learning curve under a guard, and pictures of headroom and twin: what is drawn."""

from __future__ import annotations

import numpy as np

from sb3_yann import (
    Decision,
    Headroom,
)
from sb3_yann.evaluation.plots import plot_decisions, plot_headroom


def decision(episode: int, verdict: str, cost: float, accepted: float, restored=False) -> Decision:
    return Decision(
        episode=episode, verdict=verdict, reason="why", restored=restored, candidate_cost=cost,
        accepted_cost=accepted, mpc_cost=10.0,
    )  # fmt: skip


DECISIONS = [
    decision(1, "accepted", 9.5, 9.5),
    decision(2, "accepted in part", 9.6, 9.4),
    decision(3, "rejected", 9.7, 9.4),
    decision(4, "rejected", 900.0, 9.4, restored=True),
    decision(5, "rejected", np.nan, 9.4, restored=True),
]


def drawn(axes) -> dict[str, tuple[list[float], list[float]]]:
    lines = {line.get_label(): line for line in axes.lines}
    return {
        name: (np.array(each.get_xdata()).tolist(), np.array(each.get_ydata()).tolist())
        for name, each in lines.items()
    }


def test_each_candidate_is_drawn_by_its_verdict() -> None:
    seen = drawn(plot_decisions(DECISIONS))
    assert seen["accepted policy"] == ([1, 2, 3, 4, 5], [9.5, 9.4, 9.4, 9.4, 9.4])
    assert seen["MPC"][1] == [10.0] * 5
    assert seen["accepted"] == ([1], [9.5]) and seen["accepted in part"] == ([2], [9.6])
    assert seen["refused, plays on"] == ([3], [9.7])


def test_a_candidate_far_beyond_is_drawn_at_the_edge_and_counted() -> None:
    axes = plot_decisions(DECISIONS)
    top = axes.get_ylim()[1]
    assert top < 20
    assert drawn(axes)["refused, policy restored"] == ([4, 5], [top, top])
    assert any(name.startswith("(2 beyond") for name in drawn(axes))


def test_no_decision_is_said_to_be_none() -> None:
    assert [text.get_text() for text in plot_decisions([]).texts] == ["no candidate was tried"]


def test_headroom_is_drawn_part_after_part() -> None:
    costs = np.array([10.0, 20.0])
    found = Headroom(costs, costs, costs, costs - 0.9, 0.03, 0.02, 0.01, "learn", "a simulator")
    bars = plot_headroom(found).patches
    np.testing.assert_allclose([bar.get_x() for bar in bars], [0, 3, 5, 0], atol=1e-12)
    np.testing.assert_allclose([bar.get_width() for bar in bars], [3, 2, 1, 6])
