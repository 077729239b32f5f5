"""No action noise, ever; and the scalars that tensorboard shows."""

from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, PPO, TD3
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps, LogEveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from event_files import scalars
from guard_samples import MPC, STEPS, Slide, build
from sample_plants import Ending, Recorder
from sb3_yann import ControlDiagnostics, NoActionNoise, SimulatedEpisodes, YannPolicy
from sb3_yann.callbacks import _Exploration
from weights import last_layer, unpin


def noisy(algorithm=DDPG, env: gym.Env | None = None, **kwargs):
    """Return a model that would explore in both of SB3's ways, and does not learn."""
    noise = NormalActionNoise(np.zeros(1), 0.5 * np.ones(1))
    env = Recorder(gym.make("ClippedPendulum-v0")) if env is None else env
    options = {"action_noise": noise, "learning_starts": 100, "gradient_steps": 0, "seed": 0}
    return algorithm(YannPolicy, env, **{**options, **kwargs}), env


def assert_all_actions_are_the_policy_s(model, env: Recorder) -> None:
    observations, executed = (np.array(part) for part in zip(*env.pairs, strict=True))
    predicted, _ = model.predict(observations)
    np.testing.assert_allclose(executed, predicted, atol=1e-6, rtol=0)


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_every_executed_action_is_the_policy_s_own_in_every_learn(algorithm) -> None:
    model, env = noisy(algorithm)
    model.learn(150, callback=NoActionNoise())
    model.learn(150, callback=EveryNTimesteps(10, NoActionNoise()))
    assert len(env.pairs) == 300
    assert_all_actions_are_the_policy_s(model, env)


def test_without_the_callback_the_same_model_explores() -> None:
    model, env = noisy()
    assert np.all(np.abs(model.predict(env.reset(seed=0)[0])[0]) <= 2)  # no warning yet
    words = "first 100 actions of this learn are random.*callback=NoActionNoise.*learning_starts=0"
    with pytest.warns(UserWarning, match=words) as warned:
        model.learn(150)
    assert len(warned) == 1 and warned[0].filename == __file__
    model.learn(2, reset_num_timesteps=False)  # beyond them: a warning would be an error
    with pytest.raises(AssertionError):
        assert_all_actions_are_the_policy_s(model, env)


def test_training_starts_at_once_and_still_without_noise() -> None:
    model, env = noisy(gradient_steps=1, policy_kwargs={"critic_warmup": 0}, learning_rate=0.1)
    model.learn(5, callback=NoActionNoise())
    assert model._n_updates == 5
    observations, executed = (np.array(part) for part in zip(*env.pairs, strict=True))
    with pytest.raises(AssertionError):  # the policy has moved on since
        assert_all_actions_are_the_policy_s(model, env)
    np.testing.assert_allclose(executed[0], DDPG(YannPolicy, env).predict(observations[0])[0])


def test_an_on_policy_algorithm_is_refused() -> None:
    with pytest.raises(TypeError, match="PPO"):
        PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8).learn(8, callback=NoActionNoise())


def test_diagnostics_need_a_yann_policy() -> None:
    with pytest.raises(TypeError, match="TD3Policy"):
        DDPG("MlpPolicy", "Pendulum-v1").learn(8, callback=ControlDiagnostics())


@pytest.mark.parametrize("pushed", [False, True])
def test_tensorboard_shows_distances_regions_and_violations(pushed, tmp_path) -> None:
    model, _ = noisy(tensorboard_log=str(tmp_path))
    if pushed:
        with th.no_grad():  # every output to its upper bound
            last_layer(model)[..., -1] = 100.0
            unpin(model)
    model.learn(800, callback=[NoActionNoise(), ControlDiagnostics()])  # four episodes: one dump
    shown = scalars(tmp_path)
    mean, largest = (shown[f"yann/distance_from_mpc_{name}"][-1] for name in ("mean", "max"))
    if pushed:  # fractions of the input range
        assert 0.4 < largest <= 1 and 0 < mean <= largest
        return
    assert largest < 1e-6  # nothing was learnt, nothing differs
    assert 0 <= shown["yann/region"][-1] < 7
    assert 1 <= shown["yann/regions_visited"][-1] <= 7
    assert shown["yann/violations"] == [0]
    assert shown["yann/critic_error"][-1] > 0


def test_a_dump_at_the_end_of_an_episode_leaves_all_its_steps_to_the_next() -> None:
    model, _ = noisy()
    diagnostics = ControlDiagnostics()
    model.learn(400, callback=[NoActionNoise(), LogEveryNTimesteps(200), diagnostics])
    assert len(diagnostics._distances) == len(diagnostics._regions) == 200


def test_violations_count_and_the_critic_error_compares_q_with_the_return_that_followed() -> None:
    model, _ = noisy(env=Ending(gym.make("ClippedPendulum-v0"), 3, reward=-1.0), gamma=0.5)
    states: list[np.ndarray] = []
    diagnostics = ControlDiagnostics()
    record = diagnostics._record_episode
    diagnostics._record_episode = lambda episode, info: (  # type: ignore[method-assign]
        states.extend(step[0] for step in episode),
        record(episode, info),
    )[-1]
    model.learn(3, callback=[NoActionNoise(), diagnostics], log_interval=100)
    theta = th.as_tensor(np.array(states))
    with th.no_grad():
        q = model.critic.q1_forward(theta, model.actor(theta)).numpy()[:, 0]
    returns = np.array([-1.75, -1.5, -1.0])  # three steps at -1, discounted by a half
    expected = np.abs(q - returns).mean() / np.abs(returns).mean()
    assert model.logger.name_to_value["yann/critic_error"] == pytest.approx(expected, rel=1e-5)
    model.learn(9, callback=[NoActionNoise(), diagnostics], reset_num_timesteps=False)
    assert diagnostics.violations == 3  # of each learn


FEW = {"per_episode": 3}


class Ends(Slide):
    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, self.low_start and self.t == 2, truncated, info

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        self.low_start = self.x[0] < 0
        return observation, info


def learnt(model, steps: int, *callbacks):
    return model.learn(steps, callback=[NoActionNoise(), *callbacks], reset_num_timesteps=False)


def rows(model) -> slice:
    return slice(0, model.replay_buffer.size())


def test_the_plant_meets_the_policy_alone_and_the_buffer_holds_both_in_whole_episodes() -> None:
    model = build(learning_rate=0.0)
    learnt(model, 2 * STEPS + 1, SimulatedEpisodes(Slide, **FEW))
    buffer = model.replay_buffer
    whole = 3 * STEPS
    expected = [True] * whole + [False] * STEPS + [True] * whole + [False] * STEPS + [True] * whole
    marks = np.array([*expected, False])
    law = MPC.explicit()(buffer.observations[rows(model), 0].astype(float))
    noise = np.abs(buffer.actions[rows(model), 0] - law)[:, 0]
    assert noise[~marks].max() < 1e-5 and 0.03 < noise[marks].mean() < 0.3
    ends = np.flatnonzero(buffer.dones[rows(model), 0])
    assert ends.tolist() == [STEPS * (k + 1) - 1 for k in range(11)]
    assert buffer.timeouts[ends, 0].all()  # Slide truncates
    follows = buffer.next_observations[: ends[-1], 0] == buffer.observations[1 : ends[-1] + 1, 0]
    assert follows[:, 0].tolist() == [k not in ends for k in range(ends[-1])]


def test_what_is_stored_is_what_the_simulator_did() -> None:
    model = build(learning_rate=0.0)
    learnt(model, 1, SimulatedEpisodes(Ends, per_episode=8, seed=5))
    buffer = model.replay_buffer
    at = 0
    for seed in range(5, 13):
        env = Ends()
        observation = env.reset(seed=seed)[0]
        over = False
        while not over:
            np.testing.assert_array_equal(buffer.observations[at, 0], observation)
            action = buffer.actions[at, 0]
            observation, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            np.testing.assert_array_equal(buffer.next_observations[at, 0], observation)
            assert buffer.rewards[at, 0] == pytest.approx(reward, rel=1e-6)
            assert (buffer.dones[at, 0], buffer.timeouts[at, 0]) == (over, truncated)
            at += 1
    assert at == buffer.size() - 1 and 0 < sum(buffer.timeouts[:at, 0]) < 8


def test_every_other_episode_begins_where_a_candidate_has_lost() -> None:
    model = build(learning_rate=0.0)
    model.guard_state = SimpleNamespace(evidence=SimpleNamespace(to_learn=(77, 78)))
    learnt(model, 1, SimulatedEpisodes(Slide, per_episode=40))
    begins = model.replay_buffer.observations[: 40 * STEPS : STEPS, 0, 0].tolist()
    count = [begins.count(Slide().reset(seed=seed)[0][0]) for seed in (77, 78)]
    assert min(count) > 3 and 10 < sum(count) < 30


def test_a_run_that_is_cut_off_goes_on_where_it_was() -> None:
    simulated = partial(SimulatedEpisodes, Slide, **FEW)
    whole = learnt(build(), 3 * STEPS, simulated())
    parts = learnt(build(), STEPS, simulated())
    assert parts.simulated.due and parts.simulated.episodes == 3
    learnt(parts, 2 * STEPS, simulated())
    assert parts.simulated == whole.simulated and whole.simulated.episodes == 9
    n = whole.replay_buffer.size()
    assert n == parts.replay_buffer.size() == 3 * STEPS + 9 * STEPS


@pytest.mark.parametrize("n_envs", [2, 4])
def test_with_several_envs_each_column_holds_whole_episodes_but_for_its_last(n_envs) -> None:
    model = build(TD3, env=make_vec_env(Slide, n_envs), learning_rate=0.0, n_steps=3)
    learnt(model, n_envs * (STEPS + 1), SimulatedEpisodes(Ends, per_episode=5))
    buffer = model.replay_buffer
    assert model.simulated.episodes == 10
    for column in range(n_envs):
        now, after = (
            each[rows(model), column, 0] for each in (buffer.observations, buffer.next_observations)
        )
        breaks = np.flatnonzero(now[1:] != after[:-1])
        ended = buffer.dones[rows(model), column].astype(bool)
        ended |= buffer.timeouts[rows(model), column].astype(bool)
        assert ended[breaks].all()


def test_step_tests_hold_an_action_from_all_of_the_space_for_one_to_so_many_samples() -> None:
    rng = np.random.default_rng(0)
    explore = _Exploration(
        SimulatedEpisodes(Slide, step_tests=0.1, max_hold_steps=4, noise=0.01), rng
    )
    acted = np.array([explore(np.array([0.9, -0.9])) for _ in range(20_000)])
    tested = np.abs(acted - [0.9, -0.9]).max(1) > 0.1
    assert tested.mean() == pytest.approx(2.5 / (2.5 + 9), abs=0.02)  # after 9 of noise
    held = np.all(acted[1:] == acted[:-1], axis=1)
    lengths = np.diff(np.flatnonzero(~held))
    assert set(lengths[lengths > 1]) == {2, 3, 4}
    assert np.abs(acted[tested].mean(0)).max() < 0.1 and acted[tested].min() < -0.99
    assert acted[~tested].std(0) == pytest.approx([0.01, 0.01], rel=0.15)


def test_the_training_env_itself_and_another_plant_are_refused() -> None:
    env = Slide()
    with pytest.raises(ValueError, match="The simulator is the training env"):
        learnt(build(env=env), 1, SimulatedEpisodes(env))
    with pytest.raises(ValueError, match=r"observations of shape \(4,\).* the training env \(1,\)"):
        learnt(build(), 1, SimulatedEpisodes("CSTR-v0"))
    with pytest.raises(TypeError, match="SimulatedEpisodes needs a YannPolicy"):
        DDPG("MlpPolicy", "CSTR-v0").learn(1, callback=SimulatedEpisodes("CSTR-v0"))
    with pytest.raises(ValueError, match="optimize_memory_usage=True"):
        unlike = {"handle_timeout_termination": False}
        model = build(optimize_memory_usage=True, replay_buffer_kwargs=unlike)
        learnt(model, 1, SimulatedEpisodes(Slide))


def test_its_envs_are_made_once_and_closed() -> None:
    made: list[Slide] = []

    class Closing(Slide):
        def __init__(self) -> None:
            super().__init__()
            self.open = True
            made.append(self)

        def close(self) -> None:
            self.open = False

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            assert all(each.open for each in made)
            return True

    learnt(build(), 2 * STEPS + 1, SimulatedEpisodes(Closing, **FEW), Stop())
    assert len(made) == 3 and not any(each.open for each in made)
    assert gym.spaces.utils.flatdim(made[0].action_space) == 1
