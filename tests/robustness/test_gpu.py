"""On a GPU, where Stable-Baselines3 puts models by default, all is as on the CPU, to rounding."""

import copy

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import DDPG, PPO, SAC, TD3

import general_problems
from improvement_samples import FEW, Spring, quick
from sample_laws import scrambled
from sb3_yann import ControlDiagnostics, ImprovementGuard, export, improve, report
from sb3_yann.networks import LinearPrediction, SharedYannLayer, YannLayer
from twin_samples import problem

COMMAND = "CUDA_VISIBLE_DEVICES=0 make test-all ARGS=tests/robustness/test_gpu.py"
pytestmark = [
    pytest.mark.skipif(not th.cuda.is_available(), reason=f"needs a GPU: {COMMAND}"),
    pytest.mark.filterwarnings("ignore:You are trying to run PPO on the GPU"),
]
EVERY = pytest.mark.parametrize("algorithm", [DDPG, TD3, SAC, TQC, PPO])
ROUNDING = 2e-5


def build(algorithm, device: str = "auto", **policy_kwargs):
    """Return a model that learns at once."""
    if algorithm in (SAC, TQC, PPO):
        policy_kwargs["simulator"] = True
    warm = {"critic_warmup": 0, "actor_lr_mult": 1.0}
    short = {"n_steps": 100, "batch_size": 50} if algorithm is PPO else {"learning_starts": 0}
    options = policy_kwargs if algorithm is PPO else {**warm, **policy_kwargs}
    return algorithm("YannPolicy", Spring(), policy_kwargs=options, seed=0, device=device, **short)


def points(count: int = 500) -> np.ndarray:
    return np.random.default_rng(0).uniform(-3, 3, (count, 2)).astype(np.float32)


def actions(model) -> np.ndarray:
    return model.predict(points(), deterministic=True)[0]


@EVERY
def test_it_starts_as_the_mpc_learns_and_goes_on_on_the_cpu(algorithm, tmp_path) -> None:
    model = build(algorithm)
    assert {each.device.type for each in model.policy.state_dict().values()} == {"cuda"}
    np.testing.assert_allclose(actions(model), problem().explicit()(points()), atol=2e-6)
    guard = ImprovementGuard(Spring, n_eval_episodes=3, n_new_starts=2)
    model.learn(200, callback=[guard, ControlDiagnostics()])
    assert guard.decisions
    scrambled(model.policy.actor.mu, 0.1)
    model.save(tmp_path / "model")
    other = algorithm.load(tmp_path / "model", env=Spring(), device="cpu")
    np.testing.assert_allclose(actions(other), actions(model), atol=ROUNDING)
    for each, name in ((model, "gpu"), (other, "cpu")):
        (tmp_path / name).mkdir()
        export(each, tmp_path / name / "it.c")
    assert (tmp_path / "gpu/it.c").read_bytes() == (tmp_path / "cpu/it.c").read_bytes()
    model.set_parameters(other.get_parameters())
    other.learn(100, callback=guard, reset_num_timesteps=False)


@EVERY
def test_improve_finds_the_same_for_a_model_there(algorithm, tmp_path, monkeypatch) -> None:
    quick(monkeypatch)
    models = [build(algorithm, device) for device in ("cuda", "cpu")]
    ours, theirs = (improve(each, Spring, **FEW) for each in models)
    assert ours.accepted and ours.change == pytest.approx(theirs.change, abs=1e-6)
    np.testing.assert_allclose(*map(actions, models), atol=ROUNDING)
    assert report(models[0], tmp_path / "it.html", env=Spring, seeds=range(3)).is_file()


def test_a_prediction_model_may_live_there_too() -> None:
    given = LinearPrediction(*problem().prediction).cuda()
    critics = [build(DDPG, critic={"prediction_model": each}).critic for each in (given, None)]
    at = th.as_tensor(points(), device="cuda"), th.zeros(500, 1, device="cuda")
    assert th.equal(critics[0](*at)[0], critics[1](*at)[0])


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
@pytest.mark.parametrize("name", ["servo with all of it", "two tanks, all parts"])
def test_a_layer_acts_and_learns_as_compiled(kind, name: str) -> None:
    mpc = general_problems.solved(name)
    rate = mpc.rate.du_min, mpc.rate.du_max
    layer = scrambled(kind(mpc.law(), (8, 8), rate=rate, kept=mpc.kept_set), 0.3)
    layer.confine(0.6 * mpc.theta_min, 0.8 * mpc.theta_max)
    theta = np.random.default_rng(0).uniform(
        1.2 * mpc.theta_min, 1.2 * mpc.theta_max, (400, mpc.n_theta)
    )
    found = []
    for each in (layer, copy.deepcopy(layer).cuda()):
        out = each(th.as_tensor(theta, device=each.theta_half.device))
        out.cos().sum().backward()
        gradients = [weight.grad.cpu().ravel() for weight in each.network.weights()]
        found.append((out.detach().cpu().numpy(), each.frozen()(theta), th.cat(gradients).numpy()))
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=ROUNDING * max(1, np.abs(theirs).max()))
    np.testing.assert_allclose(found[1][0], found[1][1], atol=ROUNDING)
