"""Extra signals: what networks see, and neither the law nor its value."""

import copy
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import DDPG, PPO, SAC, TD3

from improvement_samples import quick
from sample_plants import Sampled
from sb3_yann import (
    AffineObservation,
    DisturbanceBounds,
    DisturbanceObserver,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    NonFiniteWarning,
    PlantTwin,
    RateLimits,
    Tracking,
    headroom,
    improve,
    offset_free,
    report,
    retarget,
    with_extra,
)
from sb3_yann._validation import Array
from sb3_yann.evaluation import evaluate
from sb3_yann.wrappers import EstimateState, MeasuredDisturbance, PreviousInput
from weights import shake

FEED = 280.0, 310.0


def tank(**options: Any) -> LinearMPC:
    """Return the MPC of a tank in plant units, whose feed the model leaves out."""
    model = LinearModel([[0.8]], [[0.5]], dt=1.0, x_ss=[10], u_ss=[3])
    limits = {"x_min": 0, "x_max": 20, "u_min": 0, "u_max": 6}
    return LinearMPC(model, Q=[[1]], R=[[0.1]], horizon=3, **limits, **options)


class Tank(Sampled):
    """The tank: its feed, 280 to 310, moves it, wanders, and is shown last."""

    observation_space = spaces.Box(np.array([0, FEED[0]]), np.array([20, FEED[1]]), dtype=float)
    action_space = spaces.Box(0.0, 6.0, (1,), np.float64)
    starts = ([8, FEED[0]], [12, FEED[1]])
    steps = 25

    def __init__(self, effect: float = 0.02) -> None:
        self.effect = effect

    def cost(self, u: Array) -> float:
        return float((self.x[0] - 10) ** 2 + 0.1 * (u[0] - 3) ** 2)

    def moved(self, u: Array) -> Array:
        level, feed = self.x
        level = 10 + 0.8 * (level - 10) + 0.5 * (u[0] - 3) + self.effect * (feed - 295)
        return np.clip([level, feed + self.np_random.normal()], [0, FEED[0]], [20, FEED[1]])

    def info(self) -> dict[str, Any]:
        return {"disturbance": self.x[1]}


def build(kind: Any = DDPG, env: Any = None, **options: Any) -> Any:
    given = {"problem": tank(), "extra": 1, **options}
    env = Tank() if env is None else env
    return kind("YannPolicy", env, policy_kwargs=given, device="cpu", seed=0)


def observations(count: int = 200) -> Array:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(0, 20, count), rng.normal(295, 100, count)])


def perturbed(model: Any, size: float = 0.3) -> Any:
    shake(model.actor, size, seed=1)
    return model


def test_the_law_ignores_extra_signals_wherever_they_are() -> None:
    """Its regions and gains are those without them, to the bit, online as well."""
    mpc = tank(tracking=Tracking([0], 5, 15), rate=RateLimits(-1, 1))
    shown = np.random.default_rng(0).uniform([-5, 5, 0], [25, 15, 6], (500, 3))
    feed = np.random.default_rng(1).normal(0, 1e4, (500, 2))
    whole = np.column_stack([shown[:, :2], feed, shown[:, 2]])
    for solved in (False, True):
        if solved:
            mpc.explicit()
        aware = with_extra(mpc, [FEED[0], 0], [FEED[1], 1])
        assert aware.layout.names == ("x[0]", "r[0]", "d[0]", "d[1]", "u_prev[0]")
        assert [*aware.extra] == [2, 3]
        law = aware.explicit()
        np.testing.assert_array_equal(law.plant_input(whole), mpc.explicit().plant_input(shown))
        assert law.n_halfspaces == mpc.explicit().n_halfspaces
    online = aware.online().plant_input(whole)
    np.testing.assert_array_equal(online, mpc.online().plant_input(shown))
    at = aware.units.to_deviations(whole), aware.units.input_to_deviations(shown[:, 2:])
    costs = aware.value_terms(0.9).at(at[0]), aware.stage_cost(whole, shown[:, 2:])
    known = mpc.units.to_deviations(shown)
    np.testing.assert_allclose(costs[0], mpc.value_terms(0.9).at(known), rtol=1e-12)
    np.testing.assert_allclose(costs[1], mpc.stage_cost(shown, shown[:, 2:]), rtol=1e-12)


@pytest.mark.parametrize("kind", [DDPG, TD3, SAC, PPO])
def test_a_policy_with_extra_signals_starts_as_the_law(kind: Any) -> None:
    """Its critic starts as the value of the law, too; both are those without the signals."""
    model = build(kind)
    seen = observations()
    law = tank().explicit()
    u = model.predict(seen, deterministic=True)[0]
    np.testing.assert_allclose(u, law.plant_input(seen[:, :1]), atol=6e-5)
    if kind is PPO:
        return
    points = th.as_tensor(seen)
    actions = th.linspace(-1, 1, len(seen))[:, None]
    theta = model.policy.theta(seen)
    terms = tank().state_action_terms(model.gamma)
    v = 3.0 * actions.double().numpy()
    z = np.hstack([theta[:, :1].numpy(), v])
    expected = -terms.at(z)[:, None]
    q = model.critic(points, actions)[0].detach().numpy()
    np.testing.assert_allclose(q, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind", [DDPG, TD3])
def test_networks_learn_from_extra_signals_and_travel_with_the_model(
    kind: Any, tmp_path: Any
) -> None:
    """What was learnt depends on the feed; saved and loaded it is the same, and goes on."""
    model = build(kind, critic_warmup=0)
    model.learn(120, callback=NoActionNoise())
    ways = th.tensor([[9.0, FEED[0]], [9.0, FEED[1]]]).double()
    with th.no_grad():
        values = model.critic(ways, th.zeros(2, 1))[0]
    assert values[0] != values[1]
    model.save(tmp_path / "model.zip")
    loaded = kind.load(tmp_path / "model.zip", env=Tank(), device="cpu")
    seen = observations()
    np.testing.assert_array_equal(loaded.predict(seen)[0], model.predict(seen)[0])
    assert loaded.policy.problem == model.policy.problem
    loaded.learn(50, reset_num_timesteps=False)


def test_bounds_are_kept_whatever_the_networks_make_of_a_signal() -> None:
    """`keep_bounds` is the law's own set: the model's next state stays in it."""
    mpc = tank(theta_min=0, theta_max=20)
    model = perturbed(build(problem=mpc), 3.0)
    assert model.policy.keep_bounds
    seen = observations(2000)
    u = model.predict(seen)[0]
    ahead = 10 + 0.8 * (seen[:, 0] - 10) + 0.5 * (u[:, 0] - 3)
    assert np.ptp(u) > 1
    assert ahead.min() > -1e-5 and ahead.max() < 20 + 1e-5


def test_signals_come_last_whatever_else_theta_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    quick(monkeypatch)
    slow = tank(rate=RateLimits(-1, 1))

    def make() -> gym.Env[Array, Array]:
        """The feed behind the previous input."""
        env = PreviousInput(Tank(), [3.0])
        box: Any = env.observation_space
        turned = spaces.Box(box.low[[0, 2, 1]], box.high[[0, 2, 1]], dtype=box.dtype)
        return TransformObservation(env, lambda shown: shown[[0, 2, 1]], turned)

    model = build(env=make(), problem=slow)
    seen = np.column_stack([observations()[:, 0], np.full(200, 2.5), observations()[:, 1]])
    expected = slow.explicit().plant_input(seen[:, :2])
    np.testing.assert_allclose(model.predict(seen)[0], expected, atol=6e-5)
    mapped = build(observation=AffineObservation([[2.0]]))
    halved = observations() * [0.5, 1]
    expected = tank().explicit().plant_input(observations()[:, :1])
    np.testing.assert_allclose(mapped.predict(halved)[0], expected, atol=6e-5)
    found = improve(model, make, n_starts=6, rounds=1, updates=500)
    assert found.accepted and found.change < -0.05


def test_what_has_no_finite_bounds_is_refused() -> None:
    """Networks take signals in half-widths."""
    env = Tank()
    env.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    with pytest.raises(ValueError, match="finite bounds of extra signals"):
        build(env=env)
    with pytest.raises(ValueError, match=r"'extra': 1\}"):
        build(extra=0)
    with pytest.raises(ValueError, match="must lie below high"):
        with_extra(tank(), 1, 1)
    with pytest.raises(ValueError, match="extra = -1"):
        build(extra=-1)
    loaded = LinearModel([[0.8]], [[0.5]], dt=1.0, E=[[1.0]])
    limits = {"x_min": -9, "x_max": 9, "u_min": -3, "u_max": 3}
    known = {"disturbances": DisturbanceBounds(-1, 1, preview=2)}
    foreseen = LinearMPC(loaded, Q=[[1]], R=[[1]], horizon=4, **limits, **known)
    with pytest.raises(ValueError, match="preview of 2"):
        with_extra(foreseen, 0, 1)


def test_a_signal_that_is_lost_leaves_the_law() -> None:
    """NaN of the signal alone: the law acts on the rest."""
    model = perturbed(build())
    seen = observations(5)
    seen[:, 1] = np.nan
    with pytest.warns(NonFiniteWarning, match=r"entries \[1\]"):
        u = model.predict(seen)[0]
    np.testing.assert_allclose(u, tank().explicit().plant_input(seen[:, :1]), atol=6e-5)


def test_retarget_keeps_what_was_learnt_of_a_signal() -> None:
    """The correction of another MPC with the same signals is the same."""
    model = perturbed(build(networks="shared"))
    mpc = with_extra(tank(), *FEED)
    other = retarget(model, replace(mpc, R=2 * mpc.R))
    seen = observations(50)
    apart = [
        each.predict(seen)[0] - each.policy.problem.law().plant_input(seen)
        for each in (model, other)
    ]
    inside = np.all(np.abs([each.predict(seen)[0] - 3 for each in (model, other)]) < 2.9, axis=0)
    np.testing.assert_allclose(apart[0][inside], apart[1][inside], atol=1e-4)


def test_improve_learns_what_a_signal_does(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a simulator and from a log: most of what the MPC loses that does not know the feed.

    Headroom is that of who knows it, the guard keeps what was learnt, the page names the signal.
    """
    quick(monkeypatch)
    mpc = with_extra(tank(), *FEED)
    told = LinearModel([[0.8]], [[0.5]], dt=1.0, x_ss=[10], u_ss=[3], E=[[0.02]], d_ss=[295])
    oracle = replace(tank(), model=told, disturbances=DisturbanceBounds(*FEED))
    model = build(problem=mpc, extra=0)
    found = improve(model, Tank, n_starts=10, rounds=1, updates=600)
    law = mpc.law().plant_input
    rng = np.random.default_rng(100)
    log = evaluate(lambda x: np.clip(law(x) + rng.uniform(-1, 1), 0, 6), Tank, range(100, 115))
    twin = PlantTwin.fit(mpc, log.pairs, residuals=["linear"])
    learnt = improve(mpc, twin, n_starts=10, rounds=1, updates=600)
    assert found.accepted and learnt.accepted
    acting = mpc.law(), oracle.law(), found.model, learnt.model
    base, least, *costs = (evaluate(each, Tank, range(40)).costs.sum() for each in acting)
    assert least < 0.8 * base
    assert base - max(costs) > 0.5 * (base - least)
    room = headroom(mpc, Tank, n_starts=3)
    assert room.total > 0.2
    guard = ImprovementGuard(Tank, n_eval_episodes=10, n_new_starts=0, n_final_starts=10)
    model.learn(25, callback=[NoActionNoise(), guard])
    assert "accepted last is the MPC" not in guard.summary()
    page = report(model, tmp_path / "tank.html", env=Tank(), headroom=room, seeds=range(3))
    assert "d[0]" in page.read_text(encoding="utf-8")


def test_an_observer_is_told_what_its_model_ignores() -> None:
    """Extra signals beside an estimator: it goes on as without them."""
    mpc = with_extra(offset_free(tank())[0], *FEED)
    assert [*mpc.extra] == [1] and mpc.model.estimated == (1,)
    observer = DisturbanceObserver(mpc.model, state_noise=10, measurement_noise=10)

    level = spaces.Box(0.0, 20.0, (1,), np.float64)
    hidden = TransformObservation(Tank(effect=0.0), lambda shown: shown[:1], level)
    env = EstimateState(MeasuredDisturbance(hidden, *FEED), observer, -1, 1)
    model = build(env=env, problem=mpc, extra=0)
    seen = env.reset(seed=0)[0]
    assert seen.shape == (3,)
    plain, _ = offset_free(tank())
    expected = plain.law().plant_input(seen[[0, 2]])
    np.testing.assert_allclose(model.predict(seen)[0], expected, atol=6e-5)
    assert copy.deepcopy(model.policy).problem == mpc
