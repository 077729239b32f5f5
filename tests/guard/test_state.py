"""What was decided can be read, saved, drawn and shown, and a stopped run goes on from there."""

import csv
import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor

from event_files import scalars
from guard_samples import (
    LEFT,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    build,
    correct,
    make_guard,
    overwrite,
    train,
    tried,
    verdicts,
)
from sb3_yann import Decision
from sb3_yann.evaluation.plots import plot_decisions
from sb3_yann.guard import state as record
from sb3_yann.guard.state import REFUSAL_ADVICE
from weights import is_mpc

NAMES = [each.name for each in dataclasses.fields(Decision)]


def half_good(policy) -> None:
    correct(policy, LEFT, -2.0)
    correct(policy, RIGHT, 0.3)


THREE = half_good, partial(overwrite, value=np.nan), better


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_record_has_a_row_for_each_decision(tmp_path) -> None:
    path = tmp_path / "new" / "guard.csv"
    _, guard = tried(*THREE, log_path=str(path))
    written = rows(path)
    assert [*written[0]] == NAMES
    assert verdicts(guard) == ["accepted in part", "rejected", "accepted"]
    assert [row["verdict"] for row in written] == verdicts(guard)
    assert [row["episode"] for row in written] == ["1", "2", "3"]
    assert [row["timestep"] for row in written] == ["4", "8", "12"]
    assert [row["regions"] for row in written] == [str(REGION[RIGHT]), "", ""]
    assert [row["restored"] for row in written] == ["True", "True", "False"]
    assert "not a finite number" in written[1]["reason"]
    for row, decision in zip(written, guard.decisions, strict=True):
        for name in ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step"):
            np.testing.assert_equal(float(row[name]), getattr(decision, name))
    starts = dataclasses.replace(guard.state.evidence.starts, seeds=(7, 12, 5), n_hard=0)
    mpc = starts.mpc.at(slice(3))
    ours = mpc._replace(costs=mpc.costs + np.array([9.0, 8.0, -50.0]))
    confirmed = dataclasses.replace(starts, mpc=mpc), ours
    guard.state.evidence = dataclasses.replace(guard.state.evidence, confirmed=confirmed)
    for words in (
        "The policy accepted last is better than the MPC.",
        "1 accepted, 1 in part, 1 refused, in 3 episodes",
        f"most often (1 times): {guard.decisions[1].reason}",
        f"  next         {REFUSAL_ADVICE['finite']}",
        "over 3 episodes from the final starts",
        "2 cost more by more than the margin, which the rule allows: seeds 7, 12",
    ):
        assert words in guard.summary()
    guard.settings = dataclasses.replace(guard.settings, eval_freq=1000)
    assert "in 3 episodes, one every eval_freq = 1000 episodes, not steps" in guard.summary()


def test_a_mean_of_few_starts_is_what_they_cost_of_the_policy_that_has_played_all() -> None:
    evidence = tried(better, n_new_starts=0)[1].state.evidence
    assert len(evidence.scores.costs) == 10
    few = evidence.scores.at(slice(5))
    few = few._replace(costs=1.02 * few.costs)
    mean = evidence.scores.costs.mean()
    assert evidence.mean_of(few)[0] == pytest.approx(1.02 * mean)
    after = evidence.with_visited(evidence.accepted, few)
    assert after.mean_of(after.scores)[0] == pytest.approx(1.02 * mean)
    begun = dataclasses.replace(after, reference=None)
    mpc = evidence.starts.mpc.costs
    assert begun.mean_of(few)[0] == pytest.approx(few.costs.sum() / mpc[:5].sum() * mpc.mean())


def test_a_full_disk_ends_no_training_and_the_record_is_completed_later(
    tmp_path, monkeypatch
) -> None:
    path = tmp_path / "guard.csv"
    own = record.as_csv
    calls = []

    def at_times(decisions):
        calls.append(len(decisions))
        if len(calls) == 3:  # the head, the first decision, the second one
            raise OSError(28, "No space left on device")
        return own(decisions)

    monkeypatch.setattr(record, "as_csv", at_times)
    with pytest.warns(UserWarning, match=r"guard\.csv could not be written .*No space"):
        _, guard = tried(*THREE, log_path=path)
    assert [row["verdict"] for row in rows(path)] == verdicts(guard)
    assert len(guard.decisions) == 3


def test_a_record_of_another_run_is_kept_beside(tmp_path) -> None:
    path = tmp_path / "guard.csv"
    tried(*THREE, log_path=path)
    before = path.read_bytes()
    (tmp_path / "guard.1.csv").write_text("mine")
    with pytest.warns(UserWarning, match=r"guard\.csv held .* it is .*guard\.2\.csv now"):
        _, other = tried(better, log_path=path)
    assert (tmp_path / "guard.2.csv").read_bytes() == before
    assert (tmp_path / "guard.1.csv").read_text() == "mine"
    assert len(rows(path)) == len(other.decisions)


def test_tensorboard_shows_every_decision_the_last_one_too(tmp_path) -> None:
    guard = make_guard()
    model = build(gradient_steps=0, tensorboard_log=str(tmp_path))
    moves = [At([(i + 1) * STEPS], act) for i, act in enumerate(THREE)]
    last = At([3 * STEPS], partial(correct, region=RIGHT, value=0.45))
    train(model, 3 * STEPS, *moves, guard, last)
    shown = scalars(tmp_path)
    assert shown["guard/accepted"] == [1, 1, 2, 2]
    assert shown["guard/rejected"] == [0, 1, 1, 2]
    for name in ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step"):
        values = [getattr(each, name) for each in guard.decisions]
        expected = [value for value in values if np.isfinite(value)]  # one could not be played
        np.testing.assert_allclose(shown[f"guard/{name}"], expected, rtol=1e-6, atol=1e-6)
    change = [100 * (each.accepted_cost / each.mpc_cost - 1) for each in guard.decisions]
    np.testing.assert_allclose(shown["guard/accepted_change_percent"], change, rtol=1e-5)
    assert len(shown["guard/candidate_change_percent"]) == len(shown["guard/candidate_cost"]) == 3
    assert all(np.isfinite(values).all() for values in shown.values())


def saved(folder: Path) -> Any:
    return DDPG.load(folder / "accepted_model.zip", device="cpu")


def evaluates(folder: Path) -> EvalCallback:
    return EvalCallback(
        Monitor(Slide()),
        best_model_save_path=str(folder),
        eval_freq=2,
        n_eval_episodes=1,
        verbose=0,
    )


def test_the_file_holds_what_is_accepted_from_the_first_step_on(tmp_path) -> None:
    folder = tmp_path / "new" / "folder"
    model = build(gradient_steps=0)
    guard = make_guard(save_path=folder)
    seen: list[Any] = []
    look = At([1, STEPS + 1, 2 * STEPS], lambda _: seen.append(saved(folder)))
    worse = At([STEPS + 2], partial(correct, region=RIGHT, value=2.0))
    train(model, 2 * STEPS, At([2], better), worse, guard, look)
    first, accepted, later = seen
    assert is_mpc(first) and not is_mpc(accepted)
    assert actor_bits(accepted.policy) == actor_bits(later.policy) == accepted_bits(guard)
    last = saved(folder)
    assert actor_bits(last.policy) == actor_bits(model.policy)
    assert (first.num_timesteps, last.num_timesteps) == (0, 2 * STEPS)
    assert [each.name for each in folder.iterdir()] == ["accepted_model.zip"]


@pytest.mark.parametrize("nested", [False, True])
def test_a_best_model_that_nobody_accepted_is_told_and_the_accepted_one_lies_beside(
    tmp_path, nested
) -> None:
    best = evaluates(tmp_path)
    other = EveryNTimesteps(1, best) if nested else best
    model = build(gradient_steps=0)
    guard = make_guard(n_new_starts=5)
    with pytest.warns(
        UserWarning, match="best_model.zip that EvalCallback.*accepted_model.zip"
    ) as told:
        train(model, STEPS, At([2], partial(correct, region=RIGHT, value=2.0)), guard, other)
    assert sum("best_model" in str(each.message) for each in told) == 1
    assert (tmp_path / "best_model.zip").is_file()
    assert is_mpc(saved(tmp_path))


def test_a_disk_that_is_full_stops_no_training(tmp_path, monkeypatch) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(save_path=tmp_path)

    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.warns(UserWarning, match=r"accepted_model.zip could not be written \(No space"):
        train(model, STEPS, At([2], better), guard)
    assert not is_mpc(model) and [*tmp_path.iterdir()] == []


def test_a_changed_policy_is_never_called_the_mpc() -> None:
    """What a policy learnt before training is not the MPC, nor is what changed it since."""
    model = build(gradient_steps=0, actor={"critic_warmup": 99})
    guard = make_guard(Slide)
    better(model.policy)
    train(model, 2, guard)
    said = guard.summary()
    assert "is better than the MPC" in said
    assert "none was tried yet" in said and "critic_warmup = 99" in said
    other = build(gradient_steps=0)
    guard = make_guard(Slide)
    train(other, 2, At([], better), guard)
    assert "accepted last is the MPC" in guard.summary()
    better(other.policy)
    assert "The model's policy is another one, which no guard has accepted" in guard.summary()


def candidate(episode: int, verdict: str, cost: float, accepted: float, restored=False) -> Decision:
    return Decision(
        episode=episode, verdict=verdict, reason="why", restored=restored, candidate_cost=cost,
        accepted_cost=accepted, mpc_cost=10.0,
    )  # fmt: skip


DECISIONS = [
    candidate(1, "accepted", 9.5, 9.5),
    candidate(2, "accepted in part", 9.6, 9.4),
    candidate(3, "rejected", 9.7, 9.4),
    candidate(4, "rejected", 900.0, 9.4, restored=True),
    candidate(5, "rejected", np.nan, 9.4, restored=True),
]


def drawn(axes) -> dict[str, tuple[list[float], list[float]]]:
    lines = {line.get_label(): line for line in axes.lines}
    return {
        name: (np.array(each.get_xdata()).tolist(), np.array(each.get_ydata()).tolist())
        for name, each in lines.items()
    }


def test_each_candidate_is_drawn_by_its_verdict() -> None:
    seen = drawn(plot_decisions(DECISIONS))
    assert seen["accepted policy"][0] == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(seen["accepted policy"][1], [-5, -6, -6, -6, -6])
    assert seen["MPC"][1] == [0, 0]
    for name, episode, change in (
        ("accepted", 1, -5), ("accepted in part", 2, -4), ("refused, plays on", 3, -3)
    ):  # fmt: skip
        np.testing.assert_allclose(seen[name], ([episode], [change]))
    assert not any(name.startswith("pale") for name in seen)
    estimated = dataclasses.replace(DECISIONS[0], played=(5, 5, 40))
    assert any(name.startswith("pale") for name in drawn(plot_decisions([estimated])))


def test_a_candidate_far_beyond_is_drawn_at_the_edge_and_counted() -> None:
    axes = plot_decisions(DECISIONS)
    top = axes.get_ylim()[1]
    assert top < 20
    assert drawn(axes)["refused, policy restored"] == ([4, 5], [top, top])
    assert any(name.startswith("(2 beyond") for name in drawn(axes))
