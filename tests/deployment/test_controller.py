"""The numpy-only controller is what the model predicts, and falls back when a reading fails."""

import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DDPG

import general_problems
import sb3_yann._archive
import sb3_yann.deployment.controller
from deployed import CASES, disturbed, in_float64, observations, policy_of
from fresh_process import run_python
from random_problems import examples, problems
from sample_laws import reactor_in_plant_units, solved
from sample_plants import LinearPlant
from sb3_yann import (
    Checks,
    Controller,
    DisturbanceBounds,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    Tracking,
    export,
    offset_free,
    restore_accepted,
)
from sb3_yann._archive import write_arrays
from sb3_yann.deployment.code import insensitive
from sb3_yann.deployment.controller import Status
from sb3_yann.improvement.improving import Improvement
from weights import last_layer


def controller_of(given, folder: Path, **options) -> Controller:
    export(given, folder / "plant.npz", **options)
    return Controller.load(folder / "plant.npz")


@pytest.mark.parametrize("name", CASES)
def test_it_is_the_policy(name, tmp_path):
    policy = policy_of(name)
    controller = controller_of(policy, tmp_path)
    obs = observations(policy, 3_000).astype(np.float32).astype(np.float64)  # as SB3 takes it
    scale = 2 * controller.data["action_scale"]
    # In float64 by torch, which is an evaluation of its own.
    with th.no_grad():
        wanted = in_float64(policy).actor(th.as_tensor(obs)).numpy()
    wanted = wanted * controller.data["action_scale"] + controller.data["action_shift"]
    kept = np.isin(obs, insensitive(controller, obs, "double")).all(1)
    assert kept.mean() > 0.6
    found = controller.evaluate(obs)
    assert np.max(np.abs(found - wanted)[kept] / scale) < 1e-12
    # The model itself computes its networks in float32.
    predicted = policy.predict(obs, deterministic=True)[0]
    assert np.percentile(np.abs(found - predicted) / scale, 99) < 1e-5


@pytest.mark.parametrize("name", ["reactor", "references and rates", "mixed observations"])
@pytest.mark.filterwarnings("ignore::sb3_yann.NonFiniteWarning")
def test_what_is_not_finite_counts_as_in_the_policy(name, tmp_path):
    policy = policy_of(name)
    controller = controller_of(policy, tmp_path)
    obs = observations(policy, 400)
    for i, row in enumerate(obs):
        row[i % obs.shape[1]] = [np.nan, np.inf, -np.inf][i % 3]
    predicted = policy.predict(obs, deterministic=True)[0]
    scale = 2 * controller.data["action_scale"]
    assert np.max(np.abs(controller.evaluate(obs) - predicted) / scale) < 1e-6


def test_a_law_alone_is_in_plant_units(tmp_path):
    law = solved("reactor").explicit()
    theta = np.random.default_rng(0).uniform(-1, 1, (1000, 4)) * [2, 2, 2, 40]
    assert np.allclose(controller_of(law, tmp_path).evaluate(theta), law(theta), atol=1e-10)
    law = reactor_in_plant_units().explicit()
    controller = controller_of(law, tmp_path)
    shown = theta + law.theta_ss
    assert np.allclose(controller.evaluate(shown), law.plant_input(shown), atol=1e-9)
    assert controller.obs_names == ("C_A", "C_B", "C_S", "T")
    assert controller.action_names == ("U",)


def test_a_problem_is_its_law_within_its_rates(tmp_path):
    problem = general_problems.solved("servo with all of it")
    controller = controller_of(problem, tmp_path)
    low = problem.theta_min
    high = problem.theta_max
    theta = np.random.default_rng(0).uniform(1.5 * low, 1.5 * high, (2000, problem.n_theta))
    u = controller.evaluate(theta)
    previous = theta[:, -problem.model.n_inputs :]
    assert np.allclose(u, problem.explicit()(theta), atol=1e-9)
    du_min = problem.rate.du_min
    assert np.all(u <= np.maximum(previous + problem.rate.du_max, problem.u_min) + 1e-9)
    assert np.all(u >= np.minimum(previous + du_min, problem.u_max) - 1e-9)
    regulator = solved("reactor")
    alone = controller_of(regulator.explicit(), tmp_path)
    same = controller_of(regulator, tmp_path)
    assert all(np.array_equal(alone.data[key], same.data[key]) for key in alone.data)


def test_it_needs_numpy_alone(tmp_path):
    controller = controller_of(policy_of("reactor"), tmp_path)
    source = Path(sb3_yann.deployment.controller.__file__)
    for each in (source, Path(sb3_yann._archive.__file__)):
        (tmp_path / each.name).write_bytes(each.read_bytes())
    lines = """
import sys
class Wall:
    def find_spec(self, name, *rest):
        if name.split(".")[0] in ("torch", "numba", "scipy", "gymnasium", "sb3_yann"):
            raise ImportError(name)
sys.meta_path.insert(0, Wall())
from controller import Controller
print(*Controller.load("plant.npz")([0.1, 0.2, -0.1, 3.0]))
"""
    printed, _ = run_python(lines, folder=tmp_path, PYTHONPATH="")
    assert np.allclose(float(printed), controller([0.1, 0.2, -0.1, 3.0]), rtol=1e-14)


def readings(count: int = 200) -> np.ndarray:
    """A plant that moves slowly, so that a jump of the action is the controller's."""
    return np.sin(0.003 * np.arange(count)[:, None] + np.arange(4)) * [0.15, 0.15, 0.15, 1.5]


def test_a_lost_sensor_is_bridged_then_the_output_held_and_all_comes_back(tmp_path):
    checks = Checks(hold=5, recover=10, transfer=5)
    controller = controller_of(policy_of("reactor"), tmp_path, checks=checks)
    obs = readings()
    modes = []
    outputs = []
    for k, row in enumerate(obs):
        seen = row.copy()
        if 50 <= k < 70:
            seen[3] = np.nan
        outputs.append(controller(seen))
        modes.append(controller.mode)
        assert bool(controller.status & Status.NOT_FINITE) == (50 <= k < 70)
    assert modes[:50] == ["policy"] * 50
    assert modes[50:55] == ["mpc"] * 5 and modes[55:70] == ["manual"] * 15
    assert modes[70:79] == ["mpc"] * 9 and modes[79:] == ["policy"] * 121
    found = np.ravel(outputs)
    assert np.all(found[55:70] == found[54])  # held
    # A change of who acts would be a jump; it fades within five steps instead.
    by_policy, by_law = (controller.evaluate(obs, networks=each)[:, 0] for each in (True, False))
    own = np.abs(np.diff(by_policy)).max()
    jump = np.abs(by_policy - by_law).max()
    assert jump > 50 * own
    assert np.abs(np.diff(found)).max() < 1.3 * jump / 5
    assert found[85:] == pytest.approx(by_policy[85:])
    counted = controller.counters
    assert counted["steps"] == 200 and counted["changes"] == 4
    assert (counted["manual"], counted["mpc"]) == (15, 14)
    assert counted["not_finite"] == 20


def test_limits_frozen_sensors_and_late_steps(tmp_path):
    for wrong in ({"obs_min": [1], "obs_max": [0]}, {"hold": -1}):
        with pytest.raises(ValueError, match=r"obs_min must lie below obs_max|hold = -1 must"):
            Checks(**wrong)
    checks = Checks(obs_min=-50, obs_max=[9, 9, 9, 20], frozen_after=4, recover=2)
    controller = controller_of(policy_of("reactor"), tmp_path, checks=checks)
    obs = readings()
    controller([0, 0, 0, 20.5])
    assert controller.status & Status.OUT_OF_RANGE and controller.mode == "mpc"
    controller.reset()
    found = []
    for row in obs[:12]:
        controller([0.25, *row[1:]])
        found.append(bool(controller.status & Status.FROZEN))
    assert found == [False] * 4 + [True] * 8
    controller.reset()
    for _ in range(50):  # at rest nothing moves, and nothing is frozen
        controller(obs[0])
    assert controller.status == 0 and controller.mode == "policy"
    controller(obs[1], elapsed=1.6)
    assert controller.status == Status.LATE and controller.mode == "mpc"
    controller.request = "manual"
    for k in range(6):  # the output moves, and no reading answers: the whole link is frozen
        controller(obs[1], manual=[0.5 * (k % 2)])
    assert controller.status == Status.FROZEN


def test_a_lost_sensor_does_not_make_the_others_frozen(tmp_path):
    checks = Checks(frozen_after=3, hold=50)
    controller = controller_of(policy_of("reactor"), tmp_path, checks=checks)
    for k in range(20):  # at rest; one is lost for a while
        lost = [np.nan, np.inf][k % 2] if 2 <= k < 12 else 0.1
        controller([lost, 0.1, 0.1, 1.0])
        assert not controller.status & Status.FROZEN, k
    assert controller.status == 0


def test_the_operator_takes_over_and_gives_back_without_a_bump(tmp_path):
    controller = controller_of(policy_of("reactor"), tmp_path, checks=Checks(transfer=4))
    obs = readings(30) * 0.1
    before = controller(obs[0])
    controller.request = "manual"
    assert controller(obs[1]) == before
    assert controller(obs[2], manual=[40.0]) == 40.0
    assert controller(obs[3], manual=[1e6]) == 55.0  # the input's own bound
    controller.request = "policy"
    outputs = [float(controller(row)[0]) for row in obs[4:10]]
    assert outputs[0] == pytest.approx(55.0, abs=1e-6)
    assert np.all(np.abs(np.diff(outputs)) < 16)
    assert outputs[-1] == pytest.approx(float(controller.evaluate(obs[9])[0]))


@pytest.mark.filterwarnings("ignore:The plant's present input")
def test_rates_hold_whatever_happens(tmp_path):
    mpc = policy_of("references and rates").problem
    controller = controller_of(policy_of("references and rates"), tmp_path)
    generator = np.random.default_rng(0)
    previous = 0.0
    for k in range(300):
        obs = generator.uniform(-1, 1, mpc.n_theta)
        obs[-1] = previous
        if k % 17 == 0:
            obs[0] = np.nan
        if k % 23 > 19:
            obs[-1] = np.nan  # rates count from the own output then
        controller.request = ["policy", "mpc", "manual"][k // 7 % 3]
        action = float(controller(obs, manual=generator.uniform(-5, 5, 1))[0])
        assert mpc.rate.du_min - 1e-9 <= action - previous <= mpc.rate.du_max + 1e-9
        previous = action


def test_networks_that_overflow_leave_the_law(tmp_path):
    controller = controller_of(disturbed(solved("reactor")), tmp_path)
    last = f"layer{int(controller.data['n_layers']) - 1}"
    controller = Controller({**controller.data, last: np.full_like(controller.data[last], np.inf)})
    obs = readings(10)[1:]
    assert np.array_equal(controller.evaluate(obs), controller.evaluate(obs, networks=False))
    controller(obs[0])
    assert controller.status == Status.NETWORK


def test_damaged_files_and_wrong_shapes_are_named(tmp_path):
    controller = controller_of(policy_of("reactor"), tmp_path)
    path = tmp_path / "plant.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="holds no controller"):
        Controller.load(path)
    with pytest.raises(OSError):
        Controller.load(tmp_path / "none.npz")
    with pytest.raises(ValueError, match=r"obs has shape \(3,\), expected \(4,\).*C_A"):
        controller([1, 2, 3])
    with pytest.raises(ValueError, match=r"obs has shape \(2, 4\).*\. evaluate") as told:
        controller(np.zeros((2, 4)))
    assert "request" not in str(told.value)
    with pytest.raises(ValueError, match=r"manual has shape \(3,\), expected \(1,\)"):
        controller(np.zeros(4), manual=[0, 0, 0])
    controller(np.zeros(4), manual=[np.nan])
    assert controller.status == Status.NOT_FINITE and controller.mode == "policy"
    controller.request = "off"
    with pytest.raises(ValueError, match=r"^request = 'off' must be one of"):
        controller(np.zeros(4))
    with pytest.raises(ValueError, match="format 99"):
        Controller({**controller.data, "format": 99})


NO_READINGS = [np.full(4, 1j), [1j, 0, 0, 0], np.ma.array(np.full(4, 1j), mask=[1, 0, 0, 0]),
               [10**400, 0, 0, 0], th.zeros(4, requires_grad=True), ["a"] * 4]  # fmt: skip


@pytest.mark.parametrize("obs", NO_READINGS, ids=range(6))
def test_readings_that_are_no_real_numbers_are_refused_and_no_step(obs, tmp_path):
    controller = controller_of(policy_of("reactor"), tmp_path)
    for call in (controller, controller.evaluate, controller.in_domain):
        with pytest.raises(TypeError, match=r"obs must be real numbers \(.*\)\. Pass floats"):
            call(obs)
    assert controller.counters["steps"] == 0


@pytest.mark.parametrize("data", [None, "law.npz", 3])
def test_what_is_no_mapping_of_arrays_is_no_controller(data):
    with pytest.raises(
        TypeError, match=r"data = .* must be the arrays .* Controller\.load\(path\)"
    ):
        Controller(data)


def test_arrays_that_do_not_fit_together_are_named(tmp_path):
    data = controller_of(policy_of("references and rates"), tmp_path).data
    wrong = [
        ("action_scale", np.ones(2)), ("layer1", data["layer1"][:, :-1]), ("activation", "swish"),
        ("A", data["A"][:, 1:]), ("network_of", data["network_of"] + 1000), ("hold", "soon"),
    ]  # fmt: skip
    for name, value in wrong:
        write_arrays(tmp_path / "wrong.npz", {**data, name: value})
        with pytest.raises(ValueError, match="holds no controller"):
            Controller.load(tmp_path / "wrong.npz")
    write_arrays(tmp_path / "wrong.npz", {k: v for k, v in data.items() if k != "hold"})
    with pytest.raises(ValueError, match="hold"):
        Controller.load(tmp_path / "wrong.npz")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"path": "plant.xyz"}, ValueError, "format"),
        ({"path": "2 tanks.c"}, ValueError, "name = '2 tanks'"),
        ({"path": "real.st"}, ValueError, "name = 'real' is a word of Structured Text"),
        ({"path": "end_var.st"}, ValueError, "name = 'end_var' is a word of Structured Text"),
        ({"path": "no/plant.c"}, FileNotFoundError, "There is no folder"),
        ({"path": "math.c", "name": "plant"}, ValueError, "math.h"),
        ({"precision": "half"}, ValueError, "precision"),
        ({"checks": {"hold": -1}}, (TypeError, ValueError), "checks|hold"),
        ({"checks": Checks(obs_min=[1, 2])}, ValueError, "obs_min"),
    ],
)
def test_bad_arguments_write_nothing(change, error, message, tmp_path):
    options = {"path": "plant.npz", **change}
    with pytest.raises(error, match=message):
        export(policy_of("reactor"), tmp_path / options.pop("path"), **options)
    assert list(tmp_path.iterdir()) == []


def test_an_online_law_and_strange_networks_say_why_not(tmp_path):
    online = disturbed(solved("reactor"), law="online")
    with pytest.raises(ValueError, match="solved online"):
        export(online, tmp_path / "plant.st")
    with pytest.raises(ValueError, match="solved online"):
        export(solved("reactor").online(), tmp_path / "plant.c", precision="float")
    strange = disturbed(solved("reactor"), activation_fn=th.nn.Softsign)
    with pytest.raises(ValueError, match="Softsign"):
        export(strange, tmp_path / "plant.c")
    policy = disturbed(solved("reactor"))
    with th.no_grad():
        last_layer(policy)[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="weights hold NaN"):
        export(policy, tmp_path / "plant.c")
    with pytest.raises(TypeError, match="dict cannot be exported"):
        export({}, tmp_path / "plant.c")
    assert list(tmp_path.iterdir()) == []


def test_the_cost_is_said(tmp_path):
    written = export(policy_of("nothing learnt"), tmp_path / "plant.npz")
    assert written.cost.activations == 0  # networks of zeros are left out
    learnt = export(policy_of("reactor"), tmp_path / "plant.npz")
    assert learnt.cost.activations == 64
    assert 4 * learnt.cost.numbers + 4 * learnt.cost.indices < 32_000
    assert "kB float" in str(learnt) and learnt.digest in str(learnt)
    again = export(policy_of("reactor"), tmp_path / "again.npz", name="plant")
    assert again.digest == learnt.digest != written.digest


def heated() -> LinearMPC:
    """Return an offset-free MPC of a tank in its own units."""
    model = LinearModel([[0.85]], [[0.1]], dt=30, x_ss=[60], u_ss=[12], state_names=["temperature"])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[0.05]], horizon=3, u_min=0, u_max=30, theta_min=40, theta_max=80,
        tracking=Tracking([0], 50, 70),
    )  # fmt: skip
    return offset_free(mpc)[0]


def texts(folder: Path) -> str:
    found = []
    for path in folder.iterdir():
        if path.suffix in (".fmu", ".npz"):
            with zipfile.ZipFile(path) as archive:
                found += [
                    archive.read(each) for each in archive.namelist() if "binaries" not in each
                ]
        else:
            found.append(path.read_bytes())
    return b"\n".join(found).replace(b"\x00", b"").decode("latin-1")


@pytest.mark.parametrize("suffix", ["npz", "c", "onnx", "st", "xml", "fmu"])
@pytest.mark.filterwarnings("ignore:The model.s operating point")
@pytest.mark.parametrize("kind", ["problem", "law", "model"])
def test_an_export_without_its_observer_is_refused_or_says_so(suffix, kind, tmp_path) -> None:
    if suffix == "onnx":
        pytest.importorskip("onnx")
    given: Any = heated()
    if kind == "law":
        given = given.explicit()
    if kind == "model":
        policy = {"policy_kwargs": {"problem": given}}
        given = DDPG("YannPolicy", LinearPlant(given), **policy)
    with pytest.raises(ValueError, match='estimator="caller"'):
        export(given, tmp_path / f"tank.{suffix}")
    assert not [*tmp_path.iterdir()]
    written = export(given, tmp_path / f"tank.{suffix}", estimator="caller")
    assert "runs the observer" in str(written) and "runs the observer" in texts(tmp_path)
    assert "measured" not in str(written)
    if suffix == "npz":
        read = Controller.load(written.paths[0])
        assert "runs the observer" in repr(read) and "runs the observer" in read.note
        if kind != "law":
            assert read.obs_names[2] == "d[0] (estimated by the caller's observer)"


def test_a_disturbance_that_may_be_measured_or_not_comes_from_the_caller(tmp_path) -> None:
    model = LinearModel([[0.9]], [[1]], dt=1, E=[[0.5]])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, x_min=-3, x_max=3, u_min=-1, u_max=1,
        disturbances=DisturbanceBounds(-0.1, 0.1),
    )  # fmt: skip
    written = export(mpc, tmp_path / "law.npz")
    read = Controller.load(tmp_path / "law.npz")
    assert read.obs_names[1] == "d[0] (from the caller's sensor or observer)"
    assert (read.note, written.note) == ("", "") and "NOTE" not in repr(read) + str(written)
    with pytest.raises(ValueError, match="estimator = 'me' must be"):
        export(mpc, tmp_path / "law.npz", estimator="me")


def test_a_policy_that_nothing_has_confirmed_says_so_in_its_files(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0", seed=0, device="cpu", learning_starts=10**6)

    def note() -> str:
        written = export(model, tmp_path / "plant.c")
        assert (written.note in texts(tmp_path)) and ("NOTE" in str(written)) == bool(written.note)
        return written.note

    assert note() == ""  # the MPC
    learnt = last_layer(model.policy)
    with th.no_grad():
        learnt[..., -1] += 0.1
    assert note() == "Neither a guard nor improve nor a commissioning has confirmed this policy."
    model.improvements = (Improvement((), -0.1, True, policy="of another"),)
    assert note().startswith("Neither")  # what was accepted is not this one
    with th.no_grad():
        learnt[..., -1] -= 0.1
    guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_final_starts=2)
    model.learn(2, callback=[NoActionNoise(), guard])
    assert note() == ""
    with th.no_grad():
        learnt[..., -1] += 0.1
    assert note().startswith("The guard has not accepted this policy")
    restore_accepted(model)
    assert note() == ""


OPTIONS = st.sampled_from([
    {"networks": "per_region", "max_correction": 0.2},
    {"networks": "shared"},
    {"networks": "shared", "net_arch": [5], "activation_fn": th.nn.ELU},
])  # fmt: skip


def exported(given: Any, **options: Any) -> Controller:
    with tempfile.TemporaryDirectory() as folder:
        export(given, Path(folder) / "plant.npz", **options)
        return Controller.load(Path(folder) / "plant.npz")


@examples(15)
@given(problems(), st.data(), OPTIONS, st.sampled_from([0.3, 1e3, 1e30]), st.booleans())
def test_every_reading_has_an_output_within_its_bounds(
    mpc: LinearMPC, data: Any, options: dict, size: float, wide: bool
) -> None:
    policy = disturbed(mpc, size=size, **options)
    controller = exported(policy, checks=Checks(hold=2, recover=2, transfer=2))
    number = st.floats(width=64 if wide else 32)
    rows = st.lists(number, min_size=mpc.n_theta, max_size=mpc.n_theta)
    seen = np.array(data.draw(st.lists(rows, min_size=2, max_size=6)))
    low, high = (
        each.astype(np.float64) for each in (policy.action_space.low, policy.action_space.high)
    )
    room = 1e-12 * (high - low)
    u = controller.evaluate(seen)
    alone = np.array([controller.evaluate(each) for each in seen])
    steps = np.array([controller(each) for each in [*seen, *seen]])
    for each in (u, alone, steps):
        assert np.all((low - room <= each) & (each <= high + room))
    if size < 1:
        assert np.all(np.abs(alone - u) <= room)
