"""What an episode should cost from its start: a twin of the plant says, or the linear model."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from general_problems import servo
from guard_samples import (
    MPC,
    RIGHT,
    At,
    Slide,
    better,
    build,
    correct,
    guard_alone,
    random_states,
    train,
)
from sb3_yann.guard.actor_checkpoint import ActorCheckpoint
from sb3_yann.guard.covariate import Recorder, costs_in_twin, predict_by_twin
from sb3_yann.guard.statistics import PlantEpisodes
from sb3_yann.twin import PlantTwin

STEPS = 12


class Curved(Slide):
    """x+ = .9 x + .4 u + .04 x^2, which the linear model does not know; x^2 + u^2 is the cost."""

    def __init__(self, steps: int = STEPS, shown: float = 1.0) -> None:
        super().__init__(low=-4, high=3)
        self.steps, self.shown = steps, shown

    def step(self, action):
        u, x = float(np.asarray(action)[0]), float(self.x[0])
        self.x, self.t = np.array([0.9 * x + 0.4 * u + 0.04 * x * x]), self.t + 1
        seen = (self.shown * self.x).astype(np.float32)
        return seen, -(x * x + u * u), False, self.t == self.steps, {}


def curved(**kwargs):
    return build(**({"env": Curved(), "gradient_steps": 0} | kwargs))


def test_the_twin_predicts_each_episode_of_the_accepted_policy_from_its_start() -> None:
    model, guard = curved(), guard_alone(trial_episodes=5)
    less = partial(correct, region=RIGHT, value=0.3)
    train(model, 5 * STEPS, guard)
    accepted = guard.state.evidence.accepted
    train(curved_candidate := curved(env=Curved()), 5 * STEPS, guard_alone(trial_episodes=5))
    candidate = curved_candidate.guard_state.evidence.accepted  # of the same policy
    new, old, who = predict_by_twin(guard.session, candidate, accepted)
    assert who == "the twin"
    for each, given in ((new, candidate), (old, accepted)):
        np.testing.assert_allclose(each.predicted, each.costs, rtol=1e-3)
        assert np.abs(given.predicted / given.costs - 1).max() > 0.1
        np.testing.assert_array_equal(each.costs, given.costs)
    # It is the accepted policy that is predicted, whoever plays now, and it is left as it was.
    less(model.policy)
    present = ActorCheckpoint.of(model.policy)
    again, *_ = predict_by_twin(guard.session, candidate, accepted)
    np.testing.assert_array_equal(again.predicted, new.predicted)
    assert present.is_actor_of(model.policy)


def test_the_cost_in_a_twin_is_that_of_the_policy_over_the_length_of_the_episode() -> None:
    model, guard = curved(env=Curved(steps=20)), guard_alone(trial_episodes=6)
    train(model, 6 * 20, guard)
    log = guard.state.evidence.accepted.log
    twin = PlantTwin.fit(MPC, log, n_members=1)
    better(model.policy)
    checkpoint = ActorCheckpoint.of(model.policy)
    short = [(thetas[: k + 1], inputs[:k]) for k, (thetas, inputs) in enumerate(log, start=10)]
    found = costs_in_twin(guard.session, checkpoint, twin, short)
    for value, (thetas, inputs) in zip(found, short, strict=True):
        env, expected = Curved(), 0.0
        env.reset(seed=0)
        env.x = thetas[0].astype(np.float64)
        for _ in inputs:
            u, _ = model.predict(env.x.astype(np.float32), deterministic=True)
            expected -= env.step(u)[1]
        assert value == pytest.approx(expected, rel=1e-3)


def test_a_candidate_is_compared_by_the_twin_with_what_the_starts_hide() -> None:
    model, guard = curved(), guard_alone(trial_episodes=10)
    move = At([10 * STEPS + 1], partial(correct, region=RIGHT, value=0.2))
    train(model, 30 * STEPS, move, guard)
    (decision,) = guard.decisions
    assert "from the same starts by the twin, p = " in decision.reason


def test_a_plant_alone_with_a_twin_draws_no_random_numbers() -> None:
    states = []
    for callbacks in ([], [guard_alone(trial_episodes=5)]):
        train(model := build(env=Curved()), 20 * STEPS, *callbacks)
        states.append([random_states(), model.env.envs[0].unwrapped.np_random.bit_generator.state])
    assert states[0] == states[1]
    assert len(model.guard_state.decisions) + model.guard_state.budget.tests > 0


def test_an_episode_is_recorded_in_the_units_of_the_problem() -> None:
    problem, recorder = servo(), Recorder()  # inputs from -1 to 2
    for k in range(3):
        recorder.add(np.full(3, k), np.array([k / 2 - 1]))
    thetas, inputs = recorder.episode(problem, np.full(3, 3))
    np.testing.assert_array_equal(thetas, np.repeat(np.arange(4.0)[:, None], 3, axis=1))
    np.testing.assert_allclose(inputs[:, 0], [-1, -0.25, 0.5])


def test_what_is_recorded_is_what_the_plant_has_played() -> None:
    model, guard = curved(), guard_alone(trial_episodes=4)
    train(model, 4 * STEPS, guard)
    buffer, log = model.replay_buffer, guard.state.evidence.accepted.log
    for k, (thetas, inputs) in enumerate(log):
        rows = slice(k * STEPS, (k + 1) * STEPS)
        np.testing.assert_array_equal(thetas[:-1], buffer.observations[rows, 0])
        np.testing.assert_array_equal(thetas[1:], buffer.next_observations[rows, 0])
        np.testing.assert_allclose(inputs, buffer.actions[rows, 0], atol=1e-6)


def a_log(problem, moves: float, count: int = 5) -> tuple[Any, ...]:
    """Return episodes of the servo on its own model, with a reference that may move within."""
    rng, log = np.random.default_rng(0), []
    for start in rng.uniform(-1, 1, (count, 2)):
        rows, inputs = [np.array([*start, 0.5])], []
        for k in range(30):
            inputs.append(problem.explicit()(rows[-1]))
            after = problem.predict(rows[-1], inputs[-1])
            after[2] += moves * (k == 15)
            rows.append(after)
        log.append((np.array(rows), np.array(inputs)))
    return tuple(log)


def servo_session(problem) -> Any:
    """Return as much of a session as is asked for until a twin is trusted."""
    return SimpleNamespace(policy=SimpleNamespace(problem=problem))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda log: log[1:], "an episode whose log is missing"),
        (lambda log: tuple((thetas[:4], u[:3]) for thetas, u in log), "too short"),
        (lambda log: tuple((np.nan * thetas, u) for thetas, u in log), "not finite"),
        (lambda log: tuple((thetas, 0 * u) for thetas, u in log), "an input that never moves"),
        (lambda log: a_log(servo(), moves=0.1), "a reference that moves"),
    ],
)
def test_where_no_twin_can_be_trusted_the_linear_model_predicts(change, why) -> None:
    problem = servo()
    predicted = np.arange(5.0)
    known = PlantEpisodes(np.ones(5), predicted, a_log(problem, moves=0.0))
    new = PlantEpisodes(np.ones(5), predicted, change(known.log))
    broken = PlantEpisodes(np.ones(5), predicted, change(known.log))
    found = predict_by_twin(servo_session(problem), new, broken)
    assert found == (new, broken, "the linear model"), why
