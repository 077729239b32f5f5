"""The examples run from any folder, print their table and save their picture; their plants."""

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import DDPG

from quadrotor import hover
from quadrotor_plant import GRAVITY, MASS, Quadrotor
from quadruple_tank import DT, LEVELS_SS, VOLTAGES_SS, QuadrupleTank, advance, write_log
from quadruple_tank import derivative as tank_derivative
from sb3_yann import LinearModel

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PRINTED = {
    "cstr": ["regions=7", "mean"],
    "pendulum": ["regions=7", "mean"],
    "own_plant": [
        "sampled every 10",
        "set-point of h2 (cm)",
        "regions and",
        "The reward is the cost of the problem in all of",
        "50 unseen set-point sequences",
        "violations",
        "worst start",
    ],
    "built_in": [
        "sampled every 0.05",
        "Unstable: 1 of 2 poles grow",
        "The reward is the cost of the problem in all of 100 steps",
        "50 unseen starts",
        "worst start",
    ],
    "quadrotor": ["OnlineLaw(constraints=241", "100 unseen starts", "worst start"],
}


NIGHTLY = [pytest.param(name, marks=pytest.mark.nightly) for name in PRINTED if name != "cstr"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cstr", *NIGHTLY])
def test_the_example_runs_to_its_picture(name, tmp_path) -> None:
    printed = run(name, tmp_path, "--episodes", "1")
    for each in PRINTED[name]:
        assert each in printed
    assert (tmp_path / "out" / f"{name}.png").stat().st_size > 10_000


PROGRAMS = [path for path in sorted(EXAMPLES.glob("*.py")) if "def main" in path.read_text("utf-8")]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.name)
def test_an_example_fits_a_page(path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 80


@pytest.mark.nightly
def test_a_log_becomes_a_report_and_a_better_controller(tmp_path) -> None:
    printed = run("from_a_log", tmp_path)
    assert "Verdict: trusted." in (tmp_path / "out" / "twin.txt").read_text(encoding="utf-8")
    costs = re.findall(r"mean cost +(.*) \(MPC\) -> (.*)", printed)[0]
    before, after = map(float, costs)
    assert after < 0.99 * before and "violations: 0" in printed
    assert "of the MPC's mean cost in the twin" in printed
    model, plain = DDPG.load(tmp_path / "out" / "from_a_log"), DDPG("YannPolicy", "CSTR-v0")
    (found,) = model.improvements
    assert found.accepted and found.change < -0.01 and found.where == "the twin"
    assert found.steps == 0 and found.episodes == 5 and found.report() in printed
    mpc = model.policy.problem  # beyond what the log shows the MPC acts
    far = np.float32(mpc.theta_max * np.eye(4))
    np.testing.assert_array_equal(model.predict(far)[0], plain.predict(far)[0])
    assert (tmp_path / "out" / "from_a_log.png").stat().st_size > 10_000


@pytest.mark.nightly
def test_three_tags_become_a_page_and_code(tmp_path) -> None:
    printed = run("outputs_only", tmp_path)
    assert "order 2" in printed and "act for [3] samples" in printed
    reached = re.search(r"the kettle is at (.*) °C", printed)
    assert abs(float(reached[1]) - 82) < 0.3
    assert (tmp_path / "out" / "kettle.html").stat().st_size > 10_000
    built = ["gcc", "-std=c99", "kettle.c", "kettle_selftest.c", "-lm", "-o", "test"]
    if shutil.which("gcc"):
        subprocess.run(built, cwd=tmp_path / "out", check=True)
        subprocess.run([tmp_path / "out" / "test"], check=True)


@pytest.mark.nightly
def test_a_cloned_policy_forgets_and_a_yann_policy_does_not(tmp_path) -> None:
    printed = run("cloned_policy", tmp_path, "--episodes", "1")
    rows = re.findall(r"│ (\d) +│ ([\d.,]+) \(\d+\) +│ ([\d.,]+) \(\d+\)", printed)
    costs = {int(n): [float(each.replace(",", "")) for each in rest] for n, *rest in rows}
    assert costs[0][0] == pytest.approx(costs[0][1], rel=0.01)  # both are the MPC at first
    assert costs[1][0] > 1.1 * costs[0][0] and costs[1][1] == costs[0][1]


HOVER = np.full(4, MASS * GRAVITY / 4)


@pytest.mark.filterwarnings("ignore:.*For Box action spaces", "ignore:.*infinity")
def test_it_falls_when_it_tilts_too_far_and_is_a_gymnasium_env() -> None:
    env = Quadrotor()
    env.reset(seed=0, options={"state": [0, 0, 0, 1.3] + [0] * 8})
    _, reward, terminated, _, info = env.step(HOVER.astype(np.float32))
    assert terminated and info["violation"] and reward < -1000
    check_env(Quadrotor(), skip_render_check=True)


def test_its_mpc_hovers_with_the_thrusts_that_carry_it() -> None:
    mpc = hover()
    np.testing.assert_allclose(mpc.model.u_ss, HOVER)
    law = mpc.online()
    env = Quadrotor()
    assert isinstance(env, gymnasium.Env)
    x, _ = env.reset(seed=0)
    for _ in range(100):
        x = env.step(np.float32(mpc.model.u_ss + law(x.astype(float))))[0]
    assert np.abs(x).max() < 0.02


def rest_of_tank(wear: float = 0.0) -> np.ndarray:
    """Return where the levels come to rest with 3 V at both pumps."""
    levels = LEVELS_SS
    for _ in range(300):
        levels = advance(levels, VOLTAGES_SS, wear=wear)
    return np.array(levels)


def test_it_rests_at_the_published_operating_point() -> None:
    # Table I of the paper prints (12.4, 12.7, 1.8, 1.4) cm; from its equations follow
    # (12.26, 12.78, 1.63, 1.41).
    assert np.max(np.abs(rest_of_tank() - LEVELS_SS)) < 0.2
    np.testing.assert_allclose(tank_derivative(rest_of_tank(), VOLTAGES_SS), 0, atol=1e-12)


def test_its_steady_gains_are_the_published_ones() -> None:
    model = LinearModel.from_env(QuadrupleTank, rest_of_tank(), VOLTAGES_SS)
    gains = np.linalg.solve(np.eye(4) - model.A, model.B)[:2]
    # G-(0) in V/V, printed as [2.6, 1.5; 1.4, 2.8]; the sensors give 0.5 V for each cm
    np.testing.assert_allclose(0.5 * gains, [[2.6, 1.5], [1.4, 2.8]], atol=0.15)


@pytest.mark.filterwarnings("ignore:.*")  # the checker recommends actions in [-1, 1]
def test_gymnasium_s_checker_finds_nothing_wrong() -> None:
    check_env(QuadrupleTank(noise=0.02), skip_render_check=True)


def test_the_log_is_the_same_each_time_and_gives_the_model(tmp_path) -> None:
    for name in ("one.csv", "two.csv"):
        write_log(tmp_path / name)
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "two.csv").read_text()
    log = np.loadtxt(tmp_path / "one.csv", delimiter=",", skiprows=1)
    x = log[:, 1:5]
    u = log[:-1, 5:7]
    d = log[:-1, 7:]
    found = LinearModel.from_data(x, u, disturbances=d, dt=DT, u_ss=VOLTAGES_SS, d_ss=[0])
    true = LinearModel.from_env(QuadrupleTank, rest_of_tank(), VOLTAGES_SS)
    assert np.max(np.abs(found.A - true.A)) < 0.06
    assert np.max(np.abs(found.B - true.B)) < 0.06
    assert np.max(np.abs(found.x_ss - rest_of_tank())) < 0.2


SCRIPT = Path(__file__).parents[2] / "examples" / "pcgym_cstr.py"


def test_it_takes_twenty_lines() -> None:
    tree = ast.parse(SCRIPT.read_text(encoding="utf-8"))
    left_out = (ast.Import, ast.ImportFrom, ast.If)  # the last one calls main
    lines = set()
    for node in ast.walk(tree):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not isinstance(node, left_out) and not text:
            lines.add(node.lineno)
    assert len(lines) <= 21  # twenty, and the call of main


@pytest.mark.skipif(importlib.util.find_spec("pcgym") is None, reason="PC-Gym is not installed")
def test_the_policy_starts_as_the_offset_free_mpc() -> None:
    import pcgym_cstr

    env = pcgym_cstr.make_env()
    law = pcgym_cstr.mpc.explicit()
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": pcgym_cstr.mpc}, gamma=0.95)
    theta, _ = env.reset(seed=0)
    for _ in range(5):
        np.testing.assert_allclose(model.predict(theta)[0], law(theta), atol=1e-4)
        theta, reward, *_, info = env.step(law(theta))
        assert reward <= 0 <= info["pcgym_cost"]
