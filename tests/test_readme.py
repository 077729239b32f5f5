"""The Python of the README and of the pages runs as it stands, and their links lead somewhere."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TransformReward
from stable_baselines3 import DDPG, SAC
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from improvement_samples import quickest
from policy_samples import scalar_mpc
from sample_plants import LinearPlant
from sb3_yann import (
    CostAudit,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    PlantTwin,
    YannPolicy,
)

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")])
MOST_LINES = 115
FOLDERS = ("benchmarks", "docs", "envs", "examples", "experiments", "sb3_yann", "tests")


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def run(name: str) -> dict[str, object]:
    """Run the blocks of a page one after the other, with a shorter training; return its names."""
    return run_code(name, "\n".join(blocks(page(name))))


def run_code(name: str, code: str) -> dict[str, object]:
    """Run code with a shorter training; return its names."""
    shortened = code.replace("20_000", "200").replace(", progress_bar=True", "")
    shortened = shortened.replace(
        'improve(model, "CSTR-v0")', 'improve(model, "CSTR-v0", rounds=1, n_starts=5, updates=50)'
    )
    for twin in ("model, twin", "mpc, PlantTwin.fit(mpc, log)"):
        short = f"improve({twin}, rounds=1, n_starts=5, updates=50)"
        shortened = shortened.replace(f"improve({twin})", short)
    shortened = shortened.replace("updates=500", "rounds=1, updates=50")
    shortened = shortened.replace("batches=2", "batches=1")
    # A number that nothing here knows would train in full.
    steps = re.findall(r"\.learn\(\s*(?:total_timesteps\s*=\s*)?([^\s,)]*)", shortened)
    assert set(steps) <= {"200"}, f"{name}: learn is called with {steps}"
    names: dict[str, object] = {}
    exec(compile(shortened, name, "exec"), names)
    return names


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub names them."""
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def write_log() -> None:
    """Write the log that the README reads: a tank under a valve at random, with gaps in time."""
    rng = np.random.default_rng(0)
    plant = LinearModel([[0.9, 0], [0.1, 0.8]], [[0.5], [1.0]], 10)
    x = np.zeros(2)
    rows = ["time,level,T,valve"]
    for k in range(300):
        valve = rng.uniform(-0.5, 0.5)
        rows.append(f"{10 * k + 500 * (k // 60)},{x[0] + 2.5},{x[1] + 35},{valve + 0.5}")
        x = plant.step(x, [valve]) + rng.normal(0, 1e-3, 2)
    Path("log.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


@pytest.mark.slow
def test_the_code_in_the_readme_runs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    train, simulate, from_log = blocks(README)
    names = run_code("README.md", train + simulate)
    assert (tmp_path / "guard.csv").exists() and (tmp_path / "cstr.zip").exists()
    state = np.zeros(2, np.float32)
    trained = names["model"]
    mpc = names["mpc"]
    np.testing.assert_allclose(trained.predict(state)[0], mpc.explicit()(state), atol=1e-5)
    write_log()
    run_code("README.md", from_log)
    assert (tmp_path / "controller.c").exists()


@pytest.fixture(autouse=True)
def quick_fits(monkeypatch) -> None:
    """Let twins be of polynomials, and improvements and episodes short."""
    quickest(monkeypatch)
    for env_id in ("CSTR-v0", "ClippedPendulum-v0"):
        monkeypatch.setattr(gym.registry[env_id], "max_episode_steps", 60)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("environments", []), ("export", ["reactor.c"]), ("guard", []), ("policy", []),
        ("improve", ["improved.zip", "commissioning.jsonl"]),
    ],
)  # fmt: skip
def test_the_code_in_a_page_runs(name, written, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(f"docs/{name}.md")
    assert all((tmp_path / each).exists() for each in written)


@pytest.mark.slow
def test_the_code_of_the_tutorial_runs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = page("docs/tutorial.md").partition("## Your own plant")[0]
    run_code("docs/tutorial.md", "\n".join(blocks(first)))
    assert (tmp_path / "cstr.zip").exists() and (tmp_path / "guard.png").exists()


@pytest.mark.slow
def test_an_environment_of_gymnasium_takes_twelve_lines() -> None:
    code = blocks(page("docs/tutorial.md"))[-1]
    assert len(code.splitlines()) <= 14
    names = run_code("docs/tutorial.md", code)
    trained = names["model"]
    mpc = names["mpc"]
    theta = 0.02 * mpc.theta_max  # type: ignore[attr-defined]
    action = trained.policy.actor_target.mu(torch.as_tensor(theta)[None])  # type: ignore[attr-defined]
    wanted = mpc.law()(theta) / mpc.u_half  # type: ignore[attr-defined]
    np.testing.assert_allclose(action.detach().numpy()[0], wanted, atol=0.02)


def test_a_log_and_equations_of_ones_own_make_an_mpc_and_an_env() -> None:
    own = page("docs/tutorial.md").partition("## Your own plant")[2]
    from_log, equations, _ = blocks(own)
    np.testing.assert_allclose(run_code("docs/tutorial.md", from_log)["plant"].A, 0.9, atol=0.01)
    names = run_code("docs/tutorial.md", equations)
    trained = names["model"]
    mpc = names["mpc"]
    action = trained.predict(np.array([20.0, 12.0]))[0]  # type: ignore[attr-defined]
    wanted = mpc.law().plant_input([20.0, 12.0])  # type: ignore[attr-defined]
    np.testing.assert_allclose(action, wanted, atol=1e-4)


def test_every_page_with_code_is_run_by_a_test() -> None:
    found = {path.stem for path in PAGES if blocks(path.read_text(encoding="utf-8"))}
    known = "README environments export guard improve mpc policy tutorial".split()
    assert found == {*known}


def test_the_tracking_problem_of_the_page_ends_at_its_reference(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run("docs/mpc.md")
    plant = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    assert names["plant"] == plant and (tmp_path / "law.npz").exists()
    law = names["tracking"].explicit()
    x = np.zeros(2)
    u = np.zeros(1)
    for _ in range(300):
        u = law(np.concatenate([x, [0.5], u]))
        x = plant.step(x, u)
    np.testing.assert_allclose(x, [0.5, 0], atol=0.01)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path) -> None:
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        found = path if not file else (path.parent / file).resolve()
        assert found.is_file(), target
        assert not anchor or anchor in anchors(found.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_files_that_are_named_exist(path) -> None:
    for name in re.findall(r"`(\w+/[\w/.-]+)`", path.read_text(encoding="utf-8")):
        if name.partition("/")[0] in FOLDERS or name.endswith(".py"):
            assert (ROOT / name).exists() or (ROOT / "sb3_yann" / name).exists(), name


def test_the_index_lists_every_page() -> None:
    index = page("docs/index.md")
    for path in ROOT.glob("docs/*.md"):
        assert path.name == "index.md" or f"]({path.name})" in index


def test_the_readme_is_one_page() -> None:
    assert len(README.splitlines()) <= MOST_LINES


def test_the_results_it_quotes_are_those_of_the_report() -> None:
    quoted = README.partition("<!-- results: begin -->")[2].partition("<!-- results: end -->")[0]
    report = page("docs/results.md").partition("## After 50 training episodes")[2]
    rows = [[cell.strip(" *") for cell in row.split("|")] for row in quoted.strip().splitlines()]
    plants = [row for row in rows if len(row) > 6 and row[2][:1].isdigit()]
    assert len(plants) == 4
    for _, plant, optimum, mpc, observer, ours_and_worst, ddpg, _ in plants:
        ours = ours_and_worst.partition("**,")[0]
        of_plant = report.partition(f"### {plant}\n")[2].partition("\n##")[0]
        explored = rf"\| \*\*YANN-RL, a simulator explored\*\* \| \d+ \| {re.escape(ours)} \|"
        assert re.search(explored, of_plant)
        others = {"optimum": optimum, "MPC": mpc, "MPC with observer": observer, "DDPG": ddpg}
        for learner, cost in others.items():
            row = rf"\| {learner} \| \d+ \| {re.escape(cost)} \|"
            assert re.search(row, of_plant) if cost != "—" else f"| {learner} |" not in of_plant


DOCS = ROOT / "docs"
PICTURES = sorted((DOCS / "pictures").glob("*.png"))
MOST_BYTES = 60_000


@pytest.mark.nightly
@pytest.mark.skipif(find_spec("myst_parser") is None, reason="Sphinx is not installed: make docs")
def test_the_site_builds_without_a_warning_and_loads_nothing(tmp_path) -> None:
    options = ["--quiet", "--fail-on-warning", "--keep-going", "-d", tmp_path / "trees"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, DOCS, tmp_path / "html"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
    for path in (tmp_path / "html").rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)[^>]*(?:src|href)=\"(https?:[^\"]*)", path.read_text("utf-8")
        )
        assert loaded == [], path
    assert (tmp_path / "html" / "_made" / "api" / "sb3_yann.YannPolicy.html").exists()
    assert "<math" in (tmp_path / "html" / "how_it_works.html").read_text("utf-8")


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_a_picture_is_small_and_on_a_page(path) -> None:
    assert path.stat().st_size < MOST_BYTES
    assert any(f"](pictures/{path.name})" in page.read_text("utf-8") for page in DOCS.glob("*.md"))


UNSEEDED = np.random.default_rng(0)
"""No env seeds it."""


class Plant(LinearPlant):
    """A first-order plant, with something to go wrong."""

    def __init__(self, **changes) -> None:
        self.changes = changes
        super().__init__(scalar_mpc())
        for name in ("observation_space", "action_space"):
            setattr(self, name, changes.get(name, getattr(self, name)))

    def reset(self, *, seed=None, options=None):
        if self.changes.get("deaf"):
            seed = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        x, reward, *rest = super().step(action)
        return x, reward + self.changes.get("noise", 0) * UNSEEDED.random(), *rest


def model(env: gym.Env | None = None, **policy_kwargs) -> DDPG:
    env = Plant() if env is None else env
    return DDPG(YannPolicy, env, policy_kwargs={"problem": scalar_mpc(), **policy_kwargs})


def learn(callback, env: gym.Env | None = None, steps: int = 5) -> None:
    model(env).learn(steps, callback=callback)


def box(low: float, high: float, size: int = 1) -> gym.spaces.Box:
    return gym.spaces.Box(low, high, (size,), np.float32)


def two_tanks() -> LinearMPC:
    plant = LinearModel([[0.9, 0.1], [0, 0.9]], [[0], [1]], 1)
    bounds = {"x_min": -5, "x_max": 5, "u_min": -1, "u_max": 1}
    return LinearMPC(plant, Q=np.eye(2), R=[[1]], horizon=6, **bounds)


def too_large() -> None:
    with patch("sb3_yann.control.mpc.linear_mpc.LARGE", 0):
        two_tanks().law()


def linear_plant_with(**changes) -> LinearMPC:
    plant = LinearModel([[0.9]], [[1]], 1)
    return LinearMPC(plant, **{"Q": [[1]], "R": [[1]], "horizon": 2, **changes})


def normalized() -> DDPG:
    return model(VecNormalize(DummyVecEnv([Plant]), training=False, norm_reward=False))


def shown_deviations() -> None:
    shown = Plant(observation_space=box(300, 400))
    shown.start = 0
    plant = LinearModel([[0.9]], [[1]], 1, x_ss=[350], u_ss=[0], state_names=["T"])
    design = {"Q": [[1]], "R": [[1]], "horizon": 2, "x_min": 345, "x_max": 355}
    problem = LinearMPC(plant, **design, u_min=-1, u_max=1)
    built = DDPG(YannPolicy, shown, policy_kwargs={"problem": problem})
    built.predict(np.array([2], np.float32))


def log(steps: int = 30) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return one episode of noise."""
    rng = np.random.default_rng(0)
    return [(rng.normal(size=(steps + 1, 1)), rng.uniform(-1, 1, (steps, 1)))]


NO_BOX = "The algorithm only supports (<class 'gymnasium.spaces.box.Box'>,) as action spaces"
RAISED = (ValueError, TypeError, AssertionError, RuntimeError, Warning)
CASES: dict[str, Callable[[], object]] = {
    # The problem
    "R must be positive definite": lambda: linear_plant_with(Q=[[0]], R=[[0]]),
    "The law needs a bounded box of theta, not": lambda: linear_plant_with(
        u_min=-1, u_max=1
    ).explicit(),
    "The MPC problem is infeasible: no theta in its box": lambda: linear_plant_with(
        x_min=8, x_max=9, u_min=-1, u_max=0
    ).explicit(),
    "The law has more than region_limit = 3 regions": lambda: two_tanks().explicit(region_limit=3),
    "The program will be solved online, at each point.": too_large,
    # The policy
    "YannPolicy has no problem: the observation space": lambda: DDPG(YannPolicy, Plant()),
    "This policy is one of TD3, not of": lambda: SAC(
        YannPolicy, Plant(), policy_kwargs={"problem": scalar_mpc()}
    ),
    "The observation has shape (3,), but the law of the problem takes theta": lambda: model(
        Plant(observation_space=box(-9, 9, 3))
    ),
    "The action space is [[-2.0], [2.0]], but the MPC has u_min = [-1.0]": lambda: model(
        Plant(action_space=box(-2, 2))
    ),
    NO_BOX: lambda: model(Plant(action_space=gym.spaces.Discrete(3))),
    "T = 2 is shown, and the operating point is 350": shown_deviations,
    "VecNormalize normalizes observations, and the law takes the state.": normalized,
    # The reward
    "The reward is not minus the cost of the problem": lambda: learn(
        [NoActionNoise(), CostAudit(steps=10)],
        TransformReward(Plant(), lambda reward: 2 * reward),
        steps=20,
    ),
    # The guard
    "The guard's env Plant is the training env": lambda: learn(
        ImprovementGuard(env := Plant()), env
    ),
    "The MPC played two episodes of the guard's env": lambda: learn(
        ImprovementGuard(lambda: gym.wrappers.TimeLimit(Plant(noise=0.1), 5), n_eval_episodes=2)
    ),
    "All 3 starts of the guard's env": lambda: learn(
        ImprovementGuard(lambda: gym.wrappers.TimeLimit(Plant(deaf=True), 5), n_eval_episodes=3)
    ),
    "The guard is within a callback of the class EveryNTimesteps": lambda: learn(
        EveryNTimesteps(2, ImprovementGuard(Plant))
    ),
    # Logs and twins
    "The twin is not to be trusted": lambda: PlantTwin.fit(scalar_mpc(), log()).env(),
}


def test_each_message_of_the_page_is_one_of_the_cases() -> None:
    quoted = re.findall(r"^\| `(.+?)` \|", page("docs/troubleshooting.md"), re.MULTILINE)
    assert set(quoted) <= set(CASES)


@pytest.mark.parametrize("beginning", CASES)
def test_the_message_begins_as_quoted(beginning: str) -> None:
    with pytest.raises(RAISED) as raised:
        CASES[beginning]()
    assert str(raised.value).startswith(beginning)
