"""RL Zoo trains, continues and replays our policy from the hyperparameters that are shipped."""

import csv
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import DDPG, TD3

import sb3_yann
from event_files import scalars
from fresh_process import run_module
from sample_plants import LinearPlant

ALGORITHMS = {"ddpg": DDPG, "td3": TD3}
EPISODE = {"CSTR-v0": 400, "ClippedPendulum-v0": 200}
NOT_THE_MODEL_S = {"n_timesteps", "callback"}  # what the zoo itself uses of an entry
HYPERPARAMETERS = files("sb3_yann") / "hyperparams"

# Stable-Baselines3 says so of each load with n_steps, and keeps the buffer's n_steps all the same.
pytestmark = pytest.mark.filterwarnings("ignore:`n_steps=10` is ignored:UserWarning")

ENTRIES = pytest.mark.parametrize(
    ("algo", "env_id"), [(algo, env_id) for algo in ALGORITHMS for env_id in EPISODE]
)


def entry_of(algo: str, env_id: str) -> dict:
    return yaml.safe_load((HYPERPARAMETERS / f"{algo}.yml").read_text(encoding="utf-8"))[env_id]


def build(algo: str, env_id: str, env: gym.Env | str, **changes):
    entry = {k: v for k, v in entry_of(algo, env_id).items() if k not in NOT_THE_MODEL_S}
    entry["policy_kwargs"] = {**entry["policy_kwargs"], **changes.pop("policy_kwargs", {})}
    return ALGORITHMS[algo](env=env, seed=0, **(entry | changes))


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_each_file_has_an_entry_for_every_environment_and_no_other(algo) -> None:
    entries = yaml.safe_load((HYPERPARAMETERS / f"{algo}.yml").read_text(encoding="utf-8"))
    assert set(entries) == set(EPISODE)


@ENTRIES
@pytest.mark.parametrize("critic", ["afterstate", "state_action"])
def test_the_critic_of_an_entry_starts_exact_on_the_linear_plant(algo, env_id, critic) -> None:
    mpc = gym.make(env_id).observation_space.problem
    plant = LinearPlant(mpc, start=0.01)  # stays in the region that holds the origin
    kwargs = {"problem": mpc, "critic": critic}
    model = build(algo, env_id, plant, policy_kwargs=kwargs, gradient_steps=0)
    model.learn(50, callback=sb3_yann.NoActionNoise())
    sample = model.replay_buffer.sample(50)
    q = model.critic.q1_forward(sample.observations, sample.actions).detach()
    size = float(q.square().mean())
    model.train(gradient_steps=1, batch_size=50)
    # Measured 1e-14; with TD3's default target_policy_noise it is above 100.
    assert model.logger.name_to_value["train/critic_loss"] < 1e-10 * size


@ENTRIES
def test_an_entry_explores_in_a_simulator_alone_guarded_and_watched(algo, env_id) -> None:
    entry = entry_of(algo, env_id)
    assert entry["n_timesteps"] == 50 * gym.spec(env_id).max_episode_steps
    guard, noise, explores, diagnostics = entry["callback"]  # the Zoo ends the first after Ctrl-C
    assert noise == "sb3_yann.NoActionNoise"
    assert diagnostics == "sb3_yann.ControlDiagnostics"
    (options,) = guard.values()
    assert [*guard] == ["sb3_yann.ImprovementGuard"]
    assert options["env"] == env_id
    sb3_yann.ImprovementGuard(**options)
    assert explores == {"sb3_yann.SimulatedEpisodes": {"env": env_id}}


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_no_option_is_set_for_a_plant(algo) -> None:
    reactor, pendulum = (entry_of(algo, env_id) for env_id in EPISODE)
    del reactor["n_timesteps"], pendulum["n_timesteps"]
    assert str(pendulum).replace("ClippedPendulum-v0", "CSTR-v0") == str(reactor)


@dataclass
class Run:
    algo: str
    env_id: str
    folder: Path

    def zoo(self, script: str, *arguments: str) -> str:
        """Run a script of the zoo in the folder, return what it printed."""
        given = ["--gym-packages", "sb3_yann", "--algo", self.algo, "--env", self.env_id]
        given += ["-f", "logs", "--seed", "0", *arguments]
        return run_module(self.folder, f"rl_zoo3.{script}", *given)

    def train(self, *arguments: str) -> None:
        with as_file(HYPERPARAMETERS / f"{self.algo}.yml") as conf_file:
            self.zoo("train", "--conf-file", str(conf_file), *arguments)

    def log(self, number: int = 1) -> Path:
        return self.folder / "logs" / self.algo / f"{self.env_id}_{number}"

    def model(self, number: int = 1):
        return ALGORITHMS[self.algo].load(self.log(number) / f"{self.env_id}.zip")


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("ddpg", "CSTR-v0"), id="ddpg-CSTR", marks=pytest.mark.nightly),
        pytest.param(("td3", "ClippedPendulum-v0"), id="td3-pendulum", marks=pytest.mark.slow),
    ],
)
def run(request, tmp_path_factory) -> Run:
    """Return a run of one episode, evaluated at its end."""
    run = Run(*request.param, tmp_path_factory.mktemp("zoo"))
    steps = str(EPISODE[run.env_id])
    evaluation = ["--eval-freq", steps, "--eval-episodes", "1"]
    run.train("-n", steps, "--tensorboard-log", "tb", "--log-interval", "1", *evaluation)
    return run


def test_a_trained_model_loads_without_solving_its_problem_again(run, monkeypatch) -> None:
    monkeypatch.delattr("sb3_yann.control.mpc.linear_mpc.solve_explicit")
    model = run.model()
    mpc = model.policy.problem
    assert model.num_timesteps == EPISODE[run.env_id]
    assert isinstance(model.policy, sb3_yann.YannPolicy)
    assert model.replay_buffer.n_steps == 10
    assert model.action_noise is None and model.learning_starts == 0
    assert np.all(np.abs(model.predict(np.zeros((1, mpc.n_theta), np.float32))[0]) <= mpc.u_max)


def test_evaluation_keeps_the_best_model_and_the_rewards(run) -> None:
    assert (run.log() / "best_model.zip").is_file()
    # Which is a candidate; the guard keeps what it accepted beside it.
    accepted = ALGORITHMS[run.algo].load(run.log() / "accepted_model.zip")
    own = accepted.policy.actor.state_dict()
    left = run.model().policy.actor.state_dict()
    assert all(th.equal(each, left[name]) for name, each in own.items())
    assert np.load(run.log() / "evaluations.npz")["results"].shape == (1, 1)


def test_tensorboard_gets_the_diagnostics_of_control(run) -> None:
    found = scalars(run.folder / "tb" / run.env_id)
    assert {"yann/distance_from_mpc_max", "yann/critic_error"} <= found.keys()
    assert found["yann/violations"][-1] == 0


@pytest.mark.nightly
def test_training_continues_from_a_saved_model(run) -> None:
    before = run.model()
    run.train("-n", "5", "-i", str(run.log() / f"{run.env_id}.zip"))
    assert run.model(2).policy.problem == before.policy.problem
    assert run.model(2)._n_updates > before._n_updates


@pytest.mark.nightly
def test_enjoy_replays_the_trained_model(run) -> None:
    steps = str(EPISODE[run.env_id])
    run.zoo("enjoy", "--exp-id", "1", "--no-render", "-n", steps, "--reward-log", "rewards")
    with (run.folder / "rewards" / "0.monitor.csv").open() as file:
        next(file)  # a comment
        (episode,) = csv.DictReader(file)
    assert episode["l"] == steps
    assert np.isfinite(float(episode["r"]))


OWN_PLANT = """
import gymnasium as gym
from policy_samples import scalar_mpc as mpc
from sample_plants import LinearPlant
make_env = lambda: gym.wrappers.TimeLimit(LinearPlant(mpc()), 20)
"""


def test_the_file_of_the_page_trains_a_plant_of_the_reader_s(tmp_path, monkeypatch) -> None:
    utils = pytest.importorskip("rl_zoo3.utils")
    page = (Path(__file__).parents[1] / "docs" / "policy.md").read_text(encoding="utf-8")
    (entry,) = yaml.safe_load(
        "MyPlant" + page.split("    MyPlant")[1].partition("\n\n-")[0]
    ).values()
    (tmp_path / "my_plant.py").write_text(OWN_PLANT)
    monkeypatch.syspath_prepend(tmp_path)
    env = sb3_yann.env_pool.make_env("my_plant:make_env")
    model = DDPG(entry["policy"], env, policy_kwargs=entry["policy_kwargs"])
    callbacks = utils.get_callback_list(entry)
    model.learn(40, callback=callbacks)  # a warning would be an error
    assert "is the MPC" in callbacks[0].summary()


optuna = pytest.importorskip("optuna")
pytest.importorskip("rl_zoo3")

from sb3_yann import tuning  # noqa: E402


def test_every_draw_builds_a_policy_that_is_the_mpc():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    seen = set()
    for _ in range(12):
        drawn = tuning.sample(study.ask())
        model = DDPG("YannPolicy", "CSTR-v0", device="cpu", **drawn)
        law = model.policy.problem.explicit()
        theta = np.float32([0.2, 0.1, -0.1, 1.0])
        assert np.allclose(model.predict(theta)[0], law(theta), atol=1e-4)
        assert model.policy.lr_mult["actor"] == drawn["policy_kwargs"]["actor_lr_mult"]
        seen.add(drawn["policy_kwargs"]["networks"])
    assert seen == {"per_region", "shared"}


def test_other_policies_keep_the_zoos_space():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    extra = {"using_her_replay_buffer": False, "her_kwargs": {}}
    assert "widths" not in HYPERPARAMS_SAMPLER["td3"](study.ask(), 1, 1, extra)
    trial = study.ask()
    HYPERPARAMS_SAMPLER["td3"](trial, 1, 1, extra)
    assert "one_minus_gamma" in trial.params and "critic_widths" not in trial.params
