"""Improvement in a twin as a part of `learn`: when, by which twin, and beside a guard."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from event_files import scalars
from sb3_yann import (
    ImproveInTwin,
    ImprovementGuard,
    NoActionNoise,
    PlantTwin,
    UntrustedTwinError,
    YannPolicy,
)
from sb3_yann.evaluation import evaluate
from twin_samples import Cart, log, problem
from weights import is_mpc

STEPS = 60
"""Of an episode of the cart."""
SHORT = {"iterations": 20}


class Calm(Cart):
    """Starts from where the MPC always comes back."""

    def reset(self, **options):
        super().reset(**options)
        self.x = self.x * [0.6, 1.0]
        return self.x.astype(np.float32), {}


def model(algorithm=DDPG, env=None, **options):
    """Return a model whose own gradient steps are left out."""
    options = {"gradient_steps": 0, "seed": 0, "device": "cpu", **options}
    return algorithm(YannPolicy, env or Calm(), **options)


@cache
def twin() -> PlantTwin:
    """Return a twin of six episodes of the MPC."""
    learner = model().learn(6 * STEPS, callback=NoActionNoise())
    return PlantTwin.from_buffer(learner)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_after_so_many_episodes_the_policy_is_better_on_the_plant(algorithm, tmp_path) -> None:
    learner = model(algorithm, tensorboard_log=str(tmp_path))
    callback = ImproveInTwin(every=3, **SHORT)
    learner.learn(7 * STEPS, callback=[NoActionNoise(), callback])
    assert [each.episode for each in callback.attempts] == [3, 6]
    assert [each.timestep for each in callback.attempts] == [3 * STEPS, 6 * STEPS]
    assert all(each.trusted and each.accepted for each in callback.attempts)
    ours, mpc = (evaluate(each, Calm, range(40)) for each in (learner, problem().explicit()))
    assert ours.costs.mean() < 0.99 * mpc.costs.mean()
    shown = scalars(tmp_path)
    for name in ("trusted", "accepted", "cost_error", "change"):
        expected = [float(getattr(each, name)) for each in callback.attempts]
        np.testing.assert_allclose(shown[f"twin/{name}"], expected, rtol=1e-5)
    assert callback.twin is not None and len(callback.twin.episodes) == 6


def test_a_given_twin_acts_before_the_first_step_and_is_never_fitted_anew() -> None:
    given = twin()
    callback = ImproveInTwin(given, every=2, **SHORT)
    learner = model()
    learner.learn(2 * STEPS, callback=[NoActionNoise(), callback])
    assert [each.timestep for each in callback.attempts] == [0, 2 * STEPS]
    assert callback.twin is given and not is_mpc(learner)


def test_what_cannot_be_trusted_changes_nothing_and_says_why(capsys) -> None:
    learner, callback = model(), ImproveInTwin(every=1, verbose=1, **SHORT)
    learner.learn(STEPS, callback=[NoActionNoise(), callback])
    (found,) = callback.attempts
    assert not found.trusted and not found.accepted and is_mpc(learner)
    assert found.reason.startswith("There is one episode")
    assert "Episode 1: There is one episode" in capsys.readouterr().out


def test_episodes_that_are_too_short_change_nothing_and_say_why() -> None:
    learner, callback = model(env=Cart(steps=3)), ImproveInTwin(every=2, **SHORT)
    learner.learn(6, callback=[NoActionNoise(), callback])
    assert "no episode of 5 steps" in callback.attempts[0].reason and is_mpc(learner)


@pytest.mark.slow
def test_envs_side_by_side_share_the_count_and_the_twin() -> None:
    learner = model(env=make_vec_env(Calm, n_envs=3))
    callback = ImproveInTwin(every=4, **SHORT)
    learner.learn(2 * 3 * STEPS, callback=[NoActionNoise(), callback])
    assert [each.episode for each in callback.attempts] == [6]
    assert callback.attempts[0].accepted and len(callback.twin.episodes) == 6


@pytest.mark.slow
def test_the_training_draws_the_same_random_numbers_with_and_without_it() -> None:
    drawn, noise = [], NormalActionNoise(np.zeros(1), np.full(1, 0.01))
    for callbacks in ([], [ImproveInTwin(every=2, **SHORT)]):
        learner = model(gradient_steps=1, learning_starts=0, action_noise=noise)
        learner.learn(4 * STEPS, callback=callbacks)
        starts = learner.replay_buffer.observations[: 4 * STEPS : STEPS].tobytes()
        drawn.append((starts, float(th.rand(1)), float(np.random.rand())))  # noqa: NPY002
        assert is_mpc(learner) == (not callbacks)
    assert drawn[0] == drawn[1]


@pytest.mark.slow
def test_it_goes_on_in_another_learn_and_after_loading(tmp_path) -> None:
    learner, callback = model(), ImproveInTwin(every=3, **SHORT)
    learner.learn(2 * STEPS, callback=[NoActionNoise(), callback])
    learner.learn(STEPS, callback=[NoActionNoise(), callback], reset_num_timesteps=False)
    assert [(each.timestep, each.episode) for each in callback.attempts] == [(3 * STEPS, 3)]
    learner.save(tmp_path / "model")
    again = DDPG.load(tmp_path / "model", env=Calm())
    other = ImproveInTwin(every=3, **SHORT)
    again.learn(3 * STEPS, callback=[NoActionNoise(), other], reset_num_timesteps=False)
    numbers = [(each.timestep, each.episode) for each in other.attempts]
    assert numbers == [(3 * STEPS, 3), (6 * STEPS, 6)] and not is_mpc(again)


@pytest.mark.parametrize("first", [True, False])
def test_to_a_guard_with_a_simulator_an_improvement_is_a_candidate(first) -> None:
    learner, callback = model(), ImproveInTwin(twin(), every=9, **SHORT)
    guard = ImprovementGuard(Calm, n_starts=20, n_new_starts=10, n_final_starts=10)
    pair = [callback, guard] if first else [guard, callback]
    learner.learn(STEPS, callback=[NoActionNoise(), *pair])
    assert callback.attempts[0].accepted
    assert [each.verdict for each in guard.decisions] == ["accepted"]
    assert not is_mpc(learner)


@pytest.mark.parametrize("first", [True, False])
def test_a_guard_on_a_plant_alone_is_not_disturbed_while_the_actor_rests(first) -> None:
    learner, callback = model(), ImproveInTwin(twin(), every=3, **SHORT)
    guard = ImprovementGuard(None, rule={"trial_episodes": 3})
    pair = [callback, guard] if first else [guard, callback]
    learner.learn(8 * STEPS, callback=[NoActionNoise(), *pair])
    # Three episodes of the MPC, three in which the actor may learn, two on trial.
    assert [each.episode for each in callback.attempts] == ([3, 6] if first else [3])
    assert callback.attempts[0].accepted and not guard.decisions


def test_what_cannot_work_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="ImproveInTwin needs a YannPolicy"):
        DDPG("MlpPolicy", Cart(), device="cpu").learn(1, callback=ImproveInTwin())
    with pytest.raises(ValueError, match=r"Fit the twin with model\.policy\.problem"):
        DDPG("YannPolicy", "CSTR-v0", device="cpu").learn(1, callback=ImproveInTwin(twin()))
    with pytest.raises(UntrustedTwinError, match="There is one episode"):
        ImproveInTwin(PlantTwin.fit(problem(), log(1)))
    with pytest.raises(TypeError, match="twin = 5 must be a PlantTwin"):
        ImproveInTwin(5)
    for wrong in ({"every": 0}, {"iterations": 0}, {"seed": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            ImproveInTwin(**wrong)
    frugal = {"handle_timeout_termination": False}
    learner = model(optimize_memory_usage=True, replay_buffer_kwargs=frugal)
    with pytest.raises(ValueError, match="optimize_memory_usage=True keeps no last states"):
        learner.learn(1, callback=ImproveInTwin())
