"""The learning curve under a guard, and pictures of headroom and twin: what is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3 import DDPG
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_yann import (
    ControlDiagnostics,
    Decision,
    Headroom,
    ImprovementGuard,
    NoActionNoise,
    PlantTwin,
)
from sb3_yann.evaluation import evaluate
from sb3_yann.evaluation.plots import (
    decisions_figure,
    headroom_figure,
    plot_costs,
    plot_decisions,
    plot_free_runs,
)
from sb3_yann_envs import problems


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


def test_training_episodes_are_drawn_behind() -> None:
    seen = drawn(plot_decisions(DECISIONS, training_costs=[9.0, 11.0]))
    assert seen["training episode"] == ([1, 2], [9.0, 11.0])


def test_no_decision_is_said_to_be_none() -> None:
    figure = decisions_figure([])
    assert [text.get_text() for text in figure.axes[0].texts] == ["no candidate was tried"]


def test_headroom_is_drawn_part_after_part() -> None:
    costs = np.array([10.0, 20.0])
    found = Headroom(costs, costs, costs, costs - 0.9, 0.03, 0.02, 0.01, "learn", "a simulator")
    bars = headroom_figure(found).axes[0].patches
    np.testing.assert_allclose([bar.get_x() for bar in bars], [0, 3, 5, 0], atol=1e-12)
    np.testing.assert_allclose([bar.get_width() for bar in bars], [3, 2, 1, 6])


def test_a_twin_draws_its_evidence() -> None:
    mpc = problems.clipped_pendulum()
    log = evaluate(mpc.explicit(), "ClippedPendulum-v0", range(5))
    twin = PlantTwin.fit(mpc, [*zip(log.observations, log.actions, strict=True)], n_members=1)
    costs, runs = twin.plot()
    (points,) = (line for line in costs.lines if line.get_label() == "held-out episode")
    np.testing.assert_array_equal(points.get_xdata(), twin.trust.predicted)
    np.testing.assert_array_equal(points.get_ydata(), twin.trust.actual)
    own = {line.get_label(): line.get_ydata() for line in runs.lines}
    np.testing.assert_array_equal(own["twin"], twin.trust.runs.errors[twin.trust.chosen])
    np.testing.assert_array_equal(own["linear model"], twin.trust.runs.errors[0])
    assert plot_costs(twin.trust, costs) is costs
    assert plot_free_runs(twin.trust, runs) is runs


@pytest.mark.slow
def test_pictures_reach_tensorboard(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0", device="cpu", tensorboard_log=str(tmp_path))
    guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_new_starts=0)
    figures = {"guard/picture": guard.plot, "law": decisions_figure_of_none}
    model.learn(10, callback=[NoActionNoise(), guard, ControlDiagnostics(figures, 4)])
    (run,) = tmp_path.iterdir()
    events = EventAccumulator(str(run)).Reload()
    assert [each.step for each in events.Images("guard/picture")] == [4, 8, 10]
    assert events.Images("law")[0].width > 300


def decisions_figure_of_none():
    return decisions_figure([])


def test_what_does_not_draw_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"figures\['law'\] = 3 must be a function"):
        ControlDiagnostics({"law": 3})
