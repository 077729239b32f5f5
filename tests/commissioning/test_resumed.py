"""What learns in a twin goes on after a stop as if there had been none, bit for bit."""

from __future__ import annotations

import json
import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from resumed import all_bits, envs, model_bits
from sb3_yann import Commissioning, Improvement, YannPolicy, improve
from sb3_yann.commissioning import commissioning
from sb3_yann.commissioning.commissioning import why_taken_back
from sb3_yann.improvement import Check
from twin_samples import Cart, twin

STEPS = 20
"""Of an episode in training; on the plant they are twice as long."""


class Short(Cart):
    """Short episodes of the cart, from where the MPC always comes back."""

    def __init__(self, steps: int = STEPS) -> None:
        super().__init__(steps)

    def reset(self, **options):
        super().reset(**options)
        self.x = self.x * [0.6, 1.0]
        return self.x.astype(np.float32), {}


def model(n_envs: int = 1, **options: Any) -> DDPG:
    options = {"seed": 0, "device": "cpu", "buffer_size": 1000, "batch_size": 16} | options
    return DDPG(YannPolicy, envs(n_envs, Short), **options)


# --- twins ----------------------------------------------------------------------------------------


def test_a_twin_that_was_saved_predicts_and_improves_as_before() -> None:
    again = pickle.loads(pickle.dumps(twin(10)))
    theta = np.array([[0.3, -0.2], [1.0, 0.4]])
    u = np.array([[0.5], [-0.1]])
    members = len(again.dynamics.members)
    now, before = (
        each.dynamics.step(np.array([theta] * members), np.array([u] * members))
        for each in (again, twin(10))
    )
    assert now.tobytes() == before.tobytes()
    found = []
    for each in (again, twin(10)):
        learner = model()
        said = improve(learner, each, updates=500, n_starts=5)
        found.append([all_bits(said), model_bits(learner)])
        assert said.accepted
    assert found[0] == found[1]


# --- on the plant ---------------------------------------------------------------------------------


def commission(path: Any, learner: DDPG | None = None) -> Commissioning:
    learner = model() if learner is None else learner
    options = {"batch": 4, "updates": 500, "max_correction": 0.2}
    return Commissioning(
        learner, partial(Short, 2 * STEPS), log_path=path / "plant.jsonl", **options
    )


def events(path: Any) -> list[dict[str, Any]]:
    """Return a record but for digests: a saved model holds the time."""
    found = [json.loads(line) for line in (path / "plant.jsonl").read_text().splitlines()]
    for each in found:
        for name in ("acting", "kept"):
            each.get("from_here", {}).get(name, [0, 0, 0])[2] = None
    return found


@pytest.mark.slow
def test_a_commissioning_that_stops_after_a_batch_goes_on_as_if_it_had_not(
    tmp_path, monkeypatch
) -> None:
    unsafe = Check(0, False, "start 3 violates a limit", 0.0, 0.0, False)
    found = Improvement((unsafe,), 0.0, False, unsafe)

    def refuse_second(*args: Any, **options: Any) -> Improvement:
        return found if options["seed"] == 2 else improve(*args, **options)

    monkeypatch.setattr(commissioning, "improve", refuse_second)
    outcomes = []
    for name in ("whole", "cut"):
        run = commission(tmp_path / name)
        for batches in (1, 2, 3):
            run = commission(tmp_path / name) if name == "cut" else run
            run.run(batches)
        assert [each.verdict for each in run.batches] == [
            "the MPC acts",
            "the MPC acts",
            "accepted",
        ]
        trained = model_bits(run.model), run.policy.max_correction, all_bits(run.batches)
        outcomes.append([*trained, events(tmp_path / name)])
    assert outcomes[0] == outcomes[1]
    again = commission(tmp_path / "cut")
    assert model_bits(again.model) == outcomes[0][0]


def test_what_the_model_had_learnt_before_still_waits_after_a_stop(tmp_path, monkeypatch) -> None:
    def learnt() -> DDPG:
        found = model()
        with th.no_grad():
            for each in found.policy.actor.parameters():
                each.add_(0.01)
        return found

    monkeypatch.setattr(commissioning, "why_taken_back", lambda *_: "a test")
    first = commission(tmp_path, learnt())
    first.run(1)
    again = commission(tmp_path, learnt())
    assert all_bits(again.accepted.candidate) == all_bits(first.accepted.candidate)
    assert again.accepted.candidate is not None
    monkeypatch.setattr(commissioning, "why_taken_back", why_taken_back)
    again.run(2)
    assert commission(tmp_path, learnt()).accepted.candidate is None  # it has been tried
