"""The README's Python runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sample_plants import LinearPlant
from sb3_yann import LinearModel, LinearMPC

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_code_in_the_readme_runs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL))
    shortened = code.replace("20_000", "500").replace(", progress_bar=True", "")
    assert shortened != code
    exec(compile(shortened, "README.md", "exec"), {"env": double_integrator()})
    assert (tmp_path / "law.npz").exists()


def test_the_plant_of_the_readme_ends_at_its_reference() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    tracking_block = next(block for block in blocks if "tracked=" in block)
    names = {"np": np, "LinearModel": LinearModel, "LinearMPC": LinearMPC}
    names["plant"] = plant = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    exec(compile(tracking_block, "README.md", "exec"), names)
    law, x, u = names["tracking"].explicit(), np.zeros(2), np.zeros(1)
    for _ in range(300):
        u = law(np.concatenate([x, [0.5], u]))
        x = plant.step(x, u)
    np.testing.assert_allclose(x, [0.5, 0], atol=0.01)


def double_integrator() -> gym.Env:
    """Return the README's plant, as the env that its reader brings."""
    plant = LinearModel([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.1)
    return LinearPlant(
        LinearMPC(
            plant, Q=[[1, 0], [0, 1]], R=[[0.1]], horizon=1, x_min=-5, x_max=5, u_min=-1, u_max=1
        )
    )


def test_the_results_it_quotes_are_those_of_the_report() -> None:
    report = (Path(__file__).parents[1] / "docs" / "results.md").read_text(encoding="utf-8")
    in_short = report.partition("## In short\n")[2].partition("\n## ")[0]
    quoted = README.partition("<!-- results: begin -->")[2].partition("<!-- results: end -->")[0]
    assert "| **YANN-RL** |" in quoted
    assert quoted.strip() == in_short.strip()


def test_the_speed_it_quotes_is_that_of_the_report() -> None:
    path = Path(__file__).parents[1] / "docs" / "performance.md"
    quoted = README.partition("<!-- speed: begin -->")[2].partition("<!-- speed: end -->")[0]
    report = path.read_text(encoding="utf-8") if path.exists() else ""
    in_short = report.partition("## In short\n")[2].partition("\n## ")[0]
    assert quoted.strip() == (in_short.strip() or "(not measured yet)")
