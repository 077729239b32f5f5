"""The table of docs/headroom.md: its cells, and the plants that it measures."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from experiments import headroom
from sb3_yann import Headroom, PlantTwin
from sb3_yann.evaluation.episodes import one_env


def found() -> Headroom:
    costs = np.array([10.0, 30.0])
    parts = 0.3, 0.25, 0.04, 0.01
    return Headroom(costs, costs, costs, costs * (1 - parts[0]), *parts[1:], "re-identify", "a toy")


def test_a_row_is_in_percent_and_has_no_offset_where_disturbances_are_measured() -> None:
    assert headroom.row(found(), False) == [
        "20.00",
        "-30.00",
        "-25.00",
        "-4.00",
        "-1.00",
        "re-identify",
    ]
    assert headroom.row(found(), True)[2] == ""


needs_pcgym = pytest.mark.skipif(
    importlib.util.find_spec("pcgym") is None, reason="PC-Gym is not installed"
)
ALL = headroom.CASES | headroom.PCGYM_CASES


@pytest.mark.parametrize(
    "name",
    [*headroom.CASES, *(pytest.param(name, marks=needs_pcgym) for name in headroom.PCGYM_CASES)],
)
def test_each_plant_shows_the_theta_of_its_mpc(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # an example writes a log
    case = ALL[name]()
    plant = case.plant.env if isinstance(case.plant, PlantTwin) else case.plant
    with one_env(plant) as env:
        theta, _ = env.reset(seed=case.seed)
        law = case.mpc.online()
        assert theta.shape == (case.mpc.n_theta,)
        assert env.observation_space.contains(env.step(np.float32(law(theta)))[0])


def test_a_table_is_put_into_the_page_when_it_is_whole(tmp_path, monkeypatch) -> None:
    measured: list[str] = []

    def measure(mpc, plant, n_starts, seed) -> Headroom:
        measured.append(mpc)
        return found()

    class Problem:
        layout = type("Layout", (), {"n_disturbances": 0})

    monkeypatch.setattr(headroom, "headroom", measure)
    cases = {name: lambda: headroom.Case(Problem, "") for name in ("one", "two")}
    monkeypatch.setattr(headroom, "CASES", cases)
    monkeypatch.setattr(headroom, "PCGYM_CASES", {})
    page = tmp_path / "headroom.md"
    page.write_text("<!-- headroom: begin -->\nold\n<!-- headroom: end -->\n", encoding="utf-8")
    headroom.main(["two", "--report", str(tmp_path)])
    assert "old" in page.read_text(encoding="utf-8") and len(measured) == 1
    headroom.main(["--report", str(tmp_path)])
    text = page.read_text(encoding="utf-8")
    assert "old" not in text and "| one | 20.00 |" in text and "| two | 20.00 |" in text
