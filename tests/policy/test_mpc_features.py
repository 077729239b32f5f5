"""Policies of problems with each feature start exactly, with a critic that is theirs."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3

from deployed import Compiled, disturbed, needs_compiler
from general_problems import solved
from policy_samples import POLICIES, build, scalar_mpc, starts, updates, with_full_buffer
from sample_plants import LinearPlant
from sb3_yann import (
    Controller,
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    OnlineLawWarning,
    RateLimits,
    Tracking,
    YannPolicy,
    export,
)
from sb3_yann.control import OnlineLaw
from sb3_yann.control.mpc import linear_mpc
from sb3_yann.networks import SharedYannLayer
from sparse_qp import FEATURES, draw
from structured_text import FunctionBlock
from weights import is_mpc

CASES = [*((name,) for name in FEATURES), FEATURES]


@pytest.mark.parametrize("features", CASES)
def test_a_policy_starts_as_the_law_and_its_critic_keeps_bellmans_equation(
    features: tuple[str, ...],
) -> None:
    mpc = draw(np.random.default_rng(11), features)
    options = {"problem": mpc, "law": "online"}
    env = LinearPlant(mpc)
    model = DDPG(YannPolicy, env, gamma=0.95, policy_kwargs=options)
    law = mpc.online()
    rng = np.random.default_rng(0)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (60, mpc.n_theta)).astype(np.float32)
    theta = theta[law.in_domain(mpc.units.to_deviations(theta))]
    played = model.predict(theta, deterministic=True)[0]
    assert np.abs((played - law.plant_input(theta)) / mpc.u_half).max() < 2e-6  # float32's room

    own = mpc.deviations
    A, B = mpc.prediction
    rest = np.array(mpc.theta_rest)
    for _ in range(500):
        rest = A @ rest + B @ law(rest)
    near = rest + 1e-3 * rng.uniform(-1, 1, (30, mpc.n_theta)) * mpc.theta_half
    near[:, own.layout.limits] = rest[own.layout.limits]
    u = law(near)
    middle = (own.u_max + own.u_min) / 2

    def q(at: Any, inputs: Any) -> Any:
        actions = (inputs - middle) / own.u_half
        points = th.as_tensor(np.hstack([at, actions]))
        with th.no_grad():
            return model.critic.values(points)[0].double().numpy()[:, 0]

    following = near @ A.T + u @ B.T
    costs = own.stage_cost(near, u)
    residual = q(near, u) + costs - 0.95 * q(following, law(following))
    assert np.abs(residual).max() < 1e-6 * max(np.abs(q(near, u)).max(), 1.0)


def test_a_critic_with_prices_learns_compiled_and_not() -> None:
    mpc = draw(np.random.default_rng(11), ("price",))
    for critic in ({}, {"kind": "state_action"}):
        options = {"problem": mpc, "law": "online", "critic": critic}
        env = LinearPlant(mpc)
        model = DDPG(
            YannPolicy, env, learning_starts=0, policy_kwargs=options, device="cpu", seed=0
        )
        before = [each.clone() for each in model.critic.parameters()]
        model.learn(40)
        assert any(
            not th.equal(a, b) for a, b in zip(before, model.critic.parameters(), strict=True)
        )
    assert not model.policy.pin_equilibrium


@pytest.mark.slow
def test_an_export_holds_theta_with_what_lies_ahead(tmp_path: Any) -> None:
    mpc = draw(np.random.default_rng(2), ("preview", "mixed", "price", "parametric"))
    mpc.explicit()
    export(mpc, tmp_path / "ahead.c")
    text = (tmp_path / "ahead.c").read_text()
    for name in mpc.labels():
        assert name in text, name
    report = mpc.report(samples=20)
    assert all(name in report for name in mpc.layout.names)


SERVOS: dict[str, dict[str, Any]] = {
    "tracking": {},
    "a measured disturbance": {"disturbances": DisturbanceBounds(-0.5, 0.5)},
    "moves that cost": {"rate": RateLimits(-0.3, 0.3, [[1.0]])},
    "a bound that changes": {"parametric_bounds": ["x_max[0]"], "infeasible": "zero_input"},
}
SOLVED = [(name, "explicit") for name in SERVOS]
ONLINE = [pytest.param(name, "online", marks=pytest.mark.nightly) for name in [*SERVOS][1:]]


@needs_compiler
@pytest.mark.parametrize(("name", "kind"), [*SOLVED, ("tracking", "online"), *ONLINE])
@pytest.mark.filterwarnings("ignore:The observation is not finite")
def test_what_is_asked_for_beyond_its_range_counts_as_at_its_end_in_every_form(
    name: str, kind: str, tmp_path: Any
) -> None:
    load = {"E": [[0.2], [0.1]]} if "disturbances" in SERVOS[name] else {}
    model = LinearModel([[0.9, 0.1], [0, 0.8]], [[0.1], [0.5]], 1, [10, 20], [3], **load)
    mpc = LinearMPC(
        model, Q=np.diag([1, 0.1]), R=[[1]], horizon=5, x_min=[8, 18], x_max=[12, 22],
        u_min=2, u_max=4, tracking=Tracking([[1, 0]], 9, 11), **SERVOS[name],
    )  # fmt: skip
    law = mpc.law(kind)
    back = mpc.units.to_deviations
    forms: dict[str, Any] = {"law": law.plant_input, "domain": lambda at: law.in_domain(back(at))}
    forms["one row after another"] = lambda at: np.array([law.plant_input(row) for row in at])
    for networks in ("per_region", "shared") if kind == "explicit" else ("shared",):
        policy = disturbed(mpc, 0.1, law=kind, networks=networks, keep_bounds=False)
        forms[networks] = lambda at, policy=policy: policy.predict(at)[0]
        forms[f"torch, {networks}"] = lambda at, policy=policy: policy.actor(
            th.as_tensor(at).requires_grad_()
        ).detach()
        forms[f"frozen, {networks}"] = lambda at, layer=policy.actor.mu: layer.frozen()(back(at))
    forms["critic"] = lambda at: policy.critic(th.as_tensor(at), th.zeros(len(at), 1))[0].detach()
    for path in ("law.npz", "policy.npz"):
        export(law if path == "law.npz" else policy, tmp_path / path)
        forms[path] = Controller.load(tmp_path / path).evaluate
    compiled = Compiled(policy, tmp_path)
    forms["C"] = lambda at: compiled.at(at)[0]
    if kind == "explicit":
        export(policy, tmp_path / "plant.st")
        block = FunctionBlock((tmp_path / "plant.st").read_text())
        forms["ST"] = lambda at: [block.step(obs=list(row), request=0)[0] for row in at]
        onnx = pytest.importorskip("onnxruntime")
        export(policy, tmp_path / "plant.onnx")
        run = onnx.InferenceSession(str(tmp_path / "plant.onnx")).run
        forms["ONNX"] = lambda at: run(None, {"obs": at})[0]

    rng = np.random.default_rng(0)
    ends = rng.uniform(mpc.theta_min, mpc.theta_max, (30, mpc.n_theta))
    side = rng.choice([-1.0, 1.0], ends.shape)
    asked = np.r_[mpc.layout.reference, mpc.layout.limits]
    ends[:, asked] = np.where(side < 0, mpc.theta_min, mpc.theta_max)[:, asked]
    outward = np.zeros_like(ends)
    outward[:, asked] = (side * mpc.theta_half)[:, asked]
    assert len(np.unique(forms["policy.npz"](ends))) > 15
    for form, answer in forms.items():
        for times in (1e-3, 1, 49):
            found = np.asarray(answer(ends + times * outward))
            np.testing.assert_array_equal(found, np.asarray(answer(ends)), form)
    rest = mpc.units.theta_ss
    for lost in (np.inf, -np.inf, np.nan):  # as of a state: a law refuses it, a policy rests
        at = np.where(np.arange(len(rest)) == asked[0], lost, rest)[None]
        for form in ("law", "domain", "one row after another"):
            with pytest.raises(ValueError, match=r"NaN or infinite .*\(as the plant shows it\)"):
                forms[form](at)
        for form in {*forms} & {"per_region", "shared", "law.npz", "policy.npz", "C", "ONNX"}:
            np.testing.assert_allclose(
                forms[form](at)[0], law.plant_input(rest), 1e-6, err_msg=form
            )


def test_set_points_need_not_lie_about_the_operating_point() -> None:
    model = LinearModel([[0.9]], [[0.5]], 1, [10], [3])
    weights = {"Q": [[1]], "R": [[1]], "horizon": 3}
    box = {"u_min": 1, "u_max": 6, "theta_min": 5, "theta_max": 15}
    mpc = LinearMPC(model, **weights, **box, tracking=Tracking([0], 11, 12))
    policy = disturbed(mpc, 0.0, law="online")
    at = np.array([[10.5, 12.0]])
    np.testing.assert_allclose(policy.predict(at)[0], mpc.law("online").plant_input(at), atol=1e-6)
    further = mpc.law("online").plant_input(at + np.array([0, 5]))
    np.testing.assert_array_equal(further, mpc.law("online").plant_input(at))


SHAPES = pytest.mark.parametrize(
    "options", [{"law": "online"}, {"networks": "shared"}, {"law": "online", "networks": "shared"}]
)


@POLICIES
@SHAPES
def test_it_starts_as_the_mpc_and_learns(algorithm, options) -> None:
    mpc = scalar_mpc(x_min=None, x_max=None, theta_min=-5, theta_max=5)
    model = with_full_buffer(algorithm, mpc, **options, critic_warmup=0)
    assert isinstance(model.actor.mu, SharedYannLayer)
    theta = starts(mpc, stretch=2.0)
    expected = mpc.online()(theta)
    assert np.abs(model.predict(theta)[0] - expected).max() < 1e-6 * 2
    assert is_mpc(model)
    updates(model, 20)
    assert not is_mpc(model)
    assert np.all(np.abs(model.predict(theta)[0]) <= 1)


@SHAPES
def test_it_is_saved_with_its_law_and_loaded_without_a_search(options, tmp_path, monkeypatch):
    mpc = scalar_mpc()
    model = with_full_buffer(TD3, mpc, **options, critic_warmup=0)
    updates(model, 5)
    model.save(tmp_path / "model.zip")
    theta = starts(mpc)
    if "law" in options:
        monkeypatch.setattr(LinearMPC, "explicit", None)
    again = TD3.load(tmp_path / "model.zip")
    assert np.array_equal(again.predict(theta)[0], model.predict(theta)[0])
    assert isinstance(again.actor.mu.base_law, OnlineLaw) == ("law" in options)
    model.policy.save(tmp_path / "policy")
    policy = YannPolicy.load(tmp_path / "policy")
    assert np.array_equal(policy.predict(theta)[0], model.predict(theta)[0])


def test_the_search_that_found_no_law_is_not_repeated_when_a_model_is_loaded(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 1)
    with pytest.warns(OnlineLawWarning, match="law='online'"):
        model = build(DDPG, scalar_mpc())
    assert isinstance(model.actor.mu, SharedYannLayer)
    model.save(tmp_path / "model.zip")
    again = DDPG.load(tmp_path / "model.zip")
    assert isinstance(again.actor.mu, SharedYannLayer)


def test_networks_per_region_need_regions() -> None:
    with pytest.raises(ValueError, match="needs the regions of an explicit law"):
        build(policy_kwargs={"law": "online", "networks": "per_region"})
    with pytest.raises(ValueError, match="networks = 'each' must be one of"):
        build(policy_kwargs={"networks": "each"})
    with pytest.raises(ValueError, match="law = 'none' must be one of"):
        build(policy_kwargs={"law": "none"})


@pytest.mark.parametrize(
    ("name", "pinned"),
    [("servo", False), ("regulator with a disturbance", False), ("regulator with rates", True)],
)
def test_the_equilibrium_is_pinned_only_where_there_is_one(name: str, pinned: bool) -> None:
    mpc = solved(name)
    policy = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs={"problem": mpc}).policy
    assert policy.pin_equilibrium is pinned
    kwargs = {"problem": mpc, "pin_equilibrium": True}
    policy = DDPG(YannPolicy, LinearPlant(mpc), policy_kwargs=kwargs).policy
    assert policy.pin_equilibrium is True
