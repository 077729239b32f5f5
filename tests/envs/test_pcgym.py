"""PC-Gym's plants: its own steps and metric, without the traps of its episodes."""

import importlib.util
import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_yann import DisturbanceBounds, DisturbanceObserver, LinearModel, LinearMPC
from sb3_yann.wrappers import ObserveDisturbance
from sb3_yann_envs import pcgym, pcgym_flow
from sb3_yann_envs.pcgym import CASES, PCGymEnv

needs_pcgym = pytest.mark.skipif(
    importlib.util.find_spec("pcgym") is None, reason="PC-Gym is not installed"
)
NAMES = sorted(CASES)


def played(env: PCGymEnv, seed: int, steps: int = 200) -> list:
    """Return the steps of an episode with random inputs, the same for each env and seed."""
    env.reset(seed=seed)
    inputs = np.random.default_rng(seed).uniform(env.u_min, env.u_max, (steps, len(env.u_min)))
    found = []
    for u in inputs.astype(np.float32):
        found.append(env.step(u))
        if found[-1][3]:
            break
    return found


def test_a_plant_that_is_not_known_is_refused_before_pcgym_is_needed() -> None:
    with pytest.raises(ValueError, match=r"'reactor' must be one of \['cstr', 'four_tank'"):
        PCGymEnv("reactor")
    with pytest.raises(TypeError, match="3 must be a name or a mapping"):
        PCGymEnv(3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"lack \['x0'\] and hold \['a_delta'\]"):
        given = CASES["cstr"]()
        PCGymEnv({**{k: v for k, v in given.items() if k != "x0"}, "a_delta": True})


def test_without_pcgym_the_error_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pcgym", None)
    with pytest.raises(ImportError, match=r"pip install 'sb3-yann\[pcgym\]'"):
        PCGymEnv("cstr")


@needs_pcgym
@pytest.mark.filterwarnings("ignore:.*precision lowered", "ignore::FutureWarning")
@pytest.mark.parametrize("name", NAMES)
def test_it_steps_and_rewards_as_pcgym_does(name: str) -> None:
    env = PCGymEnv(name, draw=False)
    theirs = pcgym._make_env()({**CASES[name](), "normalise_a": False, "normalise_o": False})
    theirs.reset()
    rng = np.random.default_rng(0)
    n = len(env.x0)
    ranges = env.x_max - env.x_min
    env.reset(seed=0)
    for _ in range(theirs.N - 1):
        u = rng.uniform(env.u_min, env.u_max).astype(np.float32)
        x, reward, ended, *_ = theirs.step(u.astype(np.float64))
        _, ours, terminated, truncated, info = env.step(u)
        # What is left is the tolerance of PC-Gym's own integrator.
        np.testing.assert_allclose((x[:n] - info["state"]) / ranges, 0, atol=1e-4)
        assert ours == pytest.approx(float(np.squeeze(reward)), abs=2e-3, rel=2e-3)
        assert ended == truncated and not terminated and info["pcgym_cost"] == -ours
    assert truncated


@needs_pcgym
@pytest.mark.parametrize("name", NAMES)
def test_a_seed_determines_an_episode_and_global_generators_play_no_part(name: str) -> None:
    noisy = {**CASES[name](), "noise": True, "noise_percentage": 0.01}
    before = np.random.get_state()[1].tolist()  # noqa: NPY002 (must stay as it is)
    one, same, other = (played(PCGymEnv(noisy), seed) for seed in (1, 1, 2))
    assert all(np.all(a[0] == b[0]) and a[1] == b[1] for a, b in zip(one, same, strict=True))
    assert np.any(one[0][0] != other[0][0])
    assert before == np.random.get_state()[1].tolist()  # noqa: NPY002


@needs_pcgym
def test_set_points_are_drawn_where_the_schedule_changes() -> None:
    env = PCGymEnv("cstr", set_points={"Ca": (0.8, 0.82)})
    shown = np.array([step[0][-1] for step in played(env, 3)])
    changes = np.flatnonzero(np.diff(shown)) + 2  # the action after which another one is shown
    assert changes.tolist() == [40, 80]
    assert np.all((shown >= np.float32(0.8)) & (shown <= np.float32(0.82)))
    with pytest.raises(ValueError, match=r"holds \['T'\]; the plant's are \['Ca'\]"):
        PCGymEnv("cstr", set_points={"T": (0, 1)})
    with pytest.raises(ValueError, match="in this order"):
        PCGymEnv("cstr", set_points={"Ca": (1, 0)})


@needs_pcgym
def test_what_is_shown_is_the_set_point_that_the_next_cost_refers_to_until_it_changes() -> None:
    env = PCGymEnv("cstr", draw=False)
    observation, _ = env.reset(seed=0)
    x = env.advance(env.x0, [300.0])[0]
    r = observation[-1]
    _, reward, *_ = env.step(np.float32([300]))
    assert reward == pytest.approx(-1e3 * (x - r) ** 2, rel=1e-5)


@needs_pcgym
def test_constraints_and_a_reward_of_the_user_are_pcgyms_own() -> None:
    bounds = {"constraints": {"T": [327.0]}, "cons_type": {"T": ["<="]}}
    rules = {"done_on_cons_vio": False, "r_penalty": False}
    own = {"custom_reward": lambda env, x, u, violated: -2.0 if violated else -1.0}
    steps = played(PCGymEnv({**CASES["cstr"](), **bounds, **rules, **own}), 0)
    violated = [step[4]["violation"] for step in steps]
    assert violated == [step[4]["state"][1] >= 327 for step in steps]
    assert any(violated) and not all(violated)
    assert [step[1] for step in steps] == [-2.0 if each else -1.0 for each in violated]


@needs_pcgym
@pytest.mark.parametrize("name", NAMES)
def test_the_linear_model_of_the_equations_is_that_of_the_simulator(name: str) -> None:
    env = PCGymEnv(name)
    model = env.linear_model()
    seen = LinearModel.from_env(env, *env.steady_state())
    np.testing.assert_allclose(seen.A, model.A, atol=1e-5 * max(np.max(np.abs(model.A)), 1e-3))
    np.testing.assert_allclose(seen.B, model.B, atol=1e-5 * np.max(np.abs(model.B)))
    assert (model.dt, model.state_names) == (env.plant.dt, env.state_names)
    assert len(model.units) == len(env.x0) + len(env.u_min)
    middle = (env.r_min + env.r_max) / 2
    np.testing.assert_allclose(model.x_ss[env.outputs], middle, atol=1e-6)
    np.testing.assert_allclose(env.advance(model.x_ss, model.u_ss), model.x_ss, atol=1e-6)
    LinearModel.from_env(env)  # from wherever the middle of the inputs rests


@needs_pcgym
@pytest.mark.parametrize("name", NAMES)
def test_an_observer_rests_an_mpc_of_the_plant_at_its_set_points(name: str) -> None:
    plant = PCGymEnv(name)
    offsets = []
    for offset_free in (False, True):
        model = plant.linear_model(offset_free=offset_free)
        weights = {"Q": np.diag(np.isin(range(len(plant.x0)), plant.outputs) * 1e3), "horizon": 1}
        box = {"disturbances": DisturbanceBounds(-1, 1)} if offset_free else {}
        R = np.diag(0.1 / (plant.u_max - plant.u_min) ** 2)
        mpc = LinearMPC(
            model, R=R, tracking=plant.tracking, **weights, **plant.bounds, **box
        )  # fmt: skip
        env = PCGymEnv(name)
        if offset_free:
            w = np.diag(model.E)
            noise = {"state_noise": w, "measurement_noise": 0.01 * w, "disturbance_noise": 10}
            d = mpc.disturbances
            env = ObserveDisturbance(env, DisturbanceObserver(model, **noise), d.d_min, d.d_max)
        law = mpc.explicit()
        theta, _ = env.reset(seed=4)
        for _ in range(19):  # the set-point stays
            theta, *_ = env.step(law.plant_input(theta))
        n = len(plant.x0)
        offsets.append(np.abs(theta[plant.outputs] - theta[n : n + len(plant.outputs)]).max())
    assert offsets[1] < 0.2 * offsets[0]


@needs_pcgym
def test_a_set_point_without_a_steady_state_is_named() -> None:
    with pytest.raises(ValueError, match=r"at the set-point \[0.99\]"):
        PCGymEnv("cstr").steady_state([0.99])


@needs_pcgym
@pytest.mark.parametrize("name", NAMES)
def test_where_no_runge_kutta_is_accurate_the_adaptive_integrator_steps(name, monkeypatch) -> None:
    env = PCGymEnv(name)
    x = []
    for steps in (pcgym_flow.STEPS, ()):
        monkeypatch.setattr(pcgym_flow, "STEPS", steps)
        pcgym_flow._chosen.cache_clear()
        x.append(PCGymEnv(name).advance(env.x0, env.u_max))
        together = PCGymEnv(name).advance([env.x0, 0.9 * env.x0], [env.u_max, env.u_min])
        np.testing.assert_allclose(together[0], x[-1], rtol=1e-12)
        np.testing.assert_allclose(together[1], env.advance(0.9 * env.x0, env.u_min), rtol=1e-5)
    np.testing.assert_allclose(x[0], x[1], atol=1e-6 * np.max(env.x_max - env.x_min))
    assert np.any(x[0] != x[1])
    pcgym_flow._chosen.cache_clear()


@needs_pcgym
def test_bad_inputs_and_starts_are_named() -> None:
    env = PCGymEnv("four_tank")
    with pytest.raises(Exception, match=r"Call env.reset\(\) before env.step\(\)"):
        env.step(np.float32([1, 1]))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="must be 2 numbers: v1, v2"):
        env.step(np.float32([np.nan, 1]))
    with pytest.raises(ValueError, match="must be 4 finite numbers: h1, h2, h3, h4"):
        env.reset(options={"state": [1, 2]})
    env.reset(options={"state": [-1.0, 1, 1, 1]})
    with pytest.raises(FloatingPointError, match="no value there"):
        env.step(np.float32([1, 1]))


@needs_pcgym
@pytest.mark.filterwarnings("ignore:.*normalized space")  # inputs are the plant's own
def test_gymnasiums_checker_has_no_complaint() -> None:
    check_env(PCGymEnv("cstr"), skip_render_check=True)


@needs_pcgym
@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_model_that_pcgym_cannot_make_by_its_name_is_played() -> None:
    from pcgym.model_classes import cstr_series_recycle

    x0 = np.array([80.0, 320.0, 60.0, 325.0])
    hot = {"T2": [321.0] * 20}
    box = {"low": np.array([0, 290, 0, 290.0]), "high": np.array([100, 360, 100, 360.0])}
    inputs = {"low": np.array([0, 0, 270, 270.0]), "high": np.array([2e-5, 2e-5, 360, 360])}
    case = {"N": 20, "tsim": 20.0, "SP": hot, "x0": x0, "o_space": box, "a_space": inputs}
    env = PCGymEnv({**case, "model": "cstr_series_recycle", "r_scale": {"T2": 1.0}})
    env.reset(seed=0, options={"state": x0})
    u = np.float32([1e-5, 1e-5, 315, 315])
    moved = env.step(u)[4]["state"] - x0
    slope = np.array(cstr_series_recycle()(x0, u.astype(float)))
    np.testing.assert_allclose(moved, env.dt * slope, rtol=0.3)
    assert env.input_names == ("F", "L", "Tc1", "Tc2")
