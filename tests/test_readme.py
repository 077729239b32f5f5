"""The Python of the README and of the pages runs as it stands, and their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from improvement_samples import quickest
from sb3_yann import LinearModel
from sb3_yann.twin import plant_twin

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")])
MOST_LINES = 115
FOLDERS = ("benchmarks", "docs", "envs", "examples", "experiments", "sb3_yann", "tests")


def page(name: str) -> str:
    """Return a page's text."""
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(text: str) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def run(name: str) -> dict[str, object]:
    """Run the blocks of a page one after the other, with a shorter training; return its names."""
    return run_code(name, "\n".join(blocks(page(name))))


def run_code(name: str, code: str) -> dict[str, object]:
    """Run code with a shorter training; return its names."""
    shortened = code.replace("20_000", "500").replace(", progress_bar=True", "")
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
    assert set(steps) <= {"500"}, f"{name}: learn is called with {steps}"
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
def test_the_code_in_the_readme_runs(tmp_path, monkeypatch, quick_fits) -> None:
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


@pytest.fixture
def quick_fits(monkeypatch) -> None:
    """Let twins be of polynomials, and improvements short."""
    monkeypatch.setattr(plant_twin, "LONG_LOG", 10**9)
    quickest(monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["export", "guard", "policy"])
def test_the_code_in_a_page_that_trains_runs(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(f"docs/{name}.md")


@pytest.mark.slow
def test_the_code_in_the_page_on_improve_runs(tmp_path, monkeypatch, quick_fits) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gym.registry["CSTR-v0"], "max_episode_steps", 100)
    run("docs/improve.md")
    assert (tmp_path / "improved.zip").exists() and (tmp_path / "commissioning.jsonl").exists()


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
    action = trained.predict(np.array([20.0]))[0]  # type: ignore[attr-defined]
    wanted = mpc.law().plant_input([20.0])  # type: ignore[attr-defined]
    np.testing.assert_allclose(action, wanted, atol=1e-4)


def test_the_code_in_the_page_of_environments_runs() -> None:
    run("docs/environments.md")


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
    for _, plant, optimum, mpc, ours, _, ddpg, _ in plants:
        of_plant = report.partition(f"### {plant}\n")[2].partition("\n###")[0]
        explored = rf"\| \*\*YANN-RL, a simulator explored\*\* \| \d+ \| {re.escape(ours)} \|"
        assert re.search(explored, of_plant)
        for learner, cost in (("optimum", optimum), ("MPC", mpc), ("DDPG", ddpg)):
            assert not cost or re.search(rf"\| {learner} \| \d+ \| {re.escape(cost)} \|", of_plant)
