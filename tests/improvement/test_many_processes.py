"""Episodes on many processes: joblib's workers, or those of a SubprocVecEnv."""

from functools import partial

import joblib
import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from improvement_samples import FEW, Spring, bits, model_of
from sb3_yann import NoActionNoise, improve
from sb3_yann.improvement.simulator import Excited, OutOfStepsError, Simulator, of_law

SEEDS = range(5)
pytestmark = pytest.mark.usefixtures("brisk")


def same(ours, theirs) -> bool:
    pairs = zip(ours.pairs, theirs.pairs, strict=True)
    return all(np.array_equal(*each) for both in pairs for each in zip(*both, strict=True))


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded")
def test_workers_of_joblib_play_the_same_episodes() -> None:
    problem = model_of().policy.problem
    alone, shared = (Simulator(problem, Spring, 0) for _ in range(2))
    controllers = {"threading": of_law(problem), "multiprocessing": Excited(problem, 0)}
    for backend, controller in controllers.items():
        ours = alone.play(controller, SEEDS)
        with joblib.parallel_config(backend, n_jobs=2):  # with dask, below
            theirs = shared.play(controller, SEEDS)
        assert same(ours, theirs)
        np.testing.assert_array_equal(ours.costs, theirs.costs)
        np.testing.assert_array_equal(ours.unsafe(), theirs.unsafe())
    assert shared.steps == alone.steps == 2 * 20 * len(SEEDS)
    assert shared.played == alone.played == 2 * len(SEEDS)


def test_workers_take_no_step_more_than_is_left() -> None:
    problem = model_of().policy.problem
    simulator = Simulator(problem, Spring, 0, max_steps=99)
    with joblib.parallel_config("threading", n_jobs=2), pytest.raises(OutOfStepsError):
        simulator.play(of_law(problem), SEEDS)
    assert simulator.steps == 59 + 39  # of the three episodes of one, and the two of the other


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_a_vec_env_is_a_simulator(kind) -> None:
    envs = kind([Spring] * 2)
    problem = model_of().policy.problem
    alone = Simulator(problem, Spring, 0)
    shared = Simulator(problem, envs, 0)
    for controller in (of_law(problem), Excited(problem, 0)):
        assert same(alone.play(controller, SEEDS), shared.play(controller, SEEDS))
    assert shared.steps == alone.steps
    envs.close()


def test_improve_finds_the_same_on_two_processes() -> None:
    models = [model_of() for _ in range(3)]
    alone = improve(models[0], Spring, **FEW)
    with joblib.parallel_config("loky", n_jobs=2):
        shared = improve(models[1], Spring, **FEW)
    envs = DummyVecEnv([partial(Spring) for _ in range(4)])
    of_envs = improve(models[2], envs, **FEW)
    for other in (shared, of_envs):
        assert other.checks == alone.checks and other.steps == alone.steps and alone.accepted
    assert bits(models[0]) == bits(models[1]) == bits(models[2])
    assert of_envs.source == "DummyVecEnv of 4"


def test_in_the_model_s_own_envs_learning_begins_new_episodes() -> None:
    envs = DummyVecEnv([Spring] * 2)
    model = DDPG("YannPolicy", envs, device="cpu").learn(6, callback=NoActionNoise())
    improve(model, envs, max_steps=25)  # an episode, and no more
    model.learn(4, callback=NoActionNoise(), reset_num_timesteps=False)
    assert [each.t for each in envs.envs] == [2, 2]


@pytest.mark.slow
def test_workers_of_dask_play_the_same_episodes() -> None:
    distributed = pytest.importorskip("distributed")
    problem = model_of().policy.problem
    ours = Simulator(problem, Spring, 0).play(of_law(problem), SEEDS)
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, distributed.Client(cluster), joblib.parallel_config("dask", n_jobs=2):
        theirs = Simulator(problem, Spring, 0).play(of_law(problem), SEEDS)
    assert same(ours, theirs)
