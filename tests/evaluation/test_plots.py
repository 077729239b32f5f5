"""What is printed and drawn of episodes."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from sb3_yann import LinearModel, LinearMPC, Tracking
from sb3_yann.evaluation import (
    Episodes,
    comparison_table,
    save_plant_trajectories,
    save_trajectories,
)
from sb3_yann.evaluation.plots import trajectories
from sb3_yann_envs.problems import clipped_pendulum


def fake(costs: list[float]) -> Episodes:
    steps = np.linspace(0, 1, 11)[:, None]
    episodes = len(costs)
    return Episodes(
        np.array(costs),
        np.zeros(episodes, int),
        (steps,) * episodes,
        (steps[1:],) * episodes,
        np.zeros(episodes, bool),
    )


def test_the_table_shows_losses_as_well_as_gains() -> None:
    console = Console(record=True, width=100, file=StringIO())
    console.print(comparison_table("costs", fake([10.0, 20.0]), fake([9.0, 27.0])))
    text = console.export_text()
    assert "-1.00" in text and text == str(
        comparison_table("costs", fake([10.0, 20.0]), fake([9.0, 27.0]))
    )
    assert "+7.00" in text
    assert "+3.00 (+20.0 %)" in text


def test_the_picture_is_a_png_that_shows_something(tmp_path) -> None:
    path = save_trajectories(
        tmp_path / "new folder" / "run.png",
        {"before": fake([1.0]), "after": fake([2.0])},
        states={0: "x"},
        inputs=["u"],
        dt=0.1,
        time_unit="s",
        limits={0: (0.9, "limit")},
    )
    image = imread(path)
    assert image.shape[0] > 300
    assert image[..., :3].std() > 0.01


def pictured(tmp_path, monkeypatch, **options) -> dict:
    """Return what `save_plant_trajectories` draws of a tank with a set-point."""
    model = LinearModel(
        np.eye(2) / 2, [[1], [0]], 0.5, [12, 3], [40], state_names=["level", "T"],
        input_names=["flow"], units={"T": "K", "flow": "L/s"},
    )  # fmt: skip
    box = {"theta_min": -5, "theta_max": 5, "u_min": -1, "u_max": 1}
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, tracking=Tracking([0], -1, 1), **box)
    x, u = np.ones((11, 3)), np.zeros((10, 1))
    x[-1, 2] = 9  # the set-point of a step that is not taken
    episodes = Episodes(np.ones(1), np.zeros(1, int), (x,), (u,), np.zeros(1, bool))
    seen: dict = {}
    draw = trajectories._draw

    def drawn(panels, runs, *rest):
        draw(panels, runs, *rest)
        seen.update(panels=panels, runs=runs, references=rest[-1])

    monkeypatch.setattr(trajectories, "_draw", drawn)
    save_plant_trajectories(tmp_path / "run.png", {"mpc": episodes}, mpc, "s", **options)
    return seen


def test_a_picture_is_in_the_units_of_the_plant_with_its_names(tmp_path, monkeypatch) -> None:
    seen = pictured(tmp_path, monkeypatch)
    labels = [panel.get_ylabel() for panel in seen["panels"]]
    assert labels == ["level", "T (K)", "flow (L/s)"]
    values = [panel.lines[0].get_ydata()[0] for panel in seen["panels"]]
    assert values == [13, 4, 40]
    set_point = seen["panels"][0].lines[1]
    assert set(set_point.get_ydata()) == {13} and set_point.get_linestyle() == "--"
    assert seen["panels"][2].lines[0].get_xdata()[1] == 0.5


def test_entries_of_the_picture_are_chosen_and_called(tmp_path, monkeypatch) -> None:
    given = {"entries": [1, 2], "labels": {2: "wanted"}, "absolute": True}
    seen = pictured(tmp_path, monkeypatch, **given)
    labels = [panel.get_ylabel() for panel in seen["panels"]]
    assert labels == ["T (K)", "wanted", "flow (L/s)"]
    assert [panel.lines[0].get_ydata()[0] for panel in seen["panels"]] == [1, 1, 0]


def test_observations_that_are_not_theta_are_refused(tmp_path) -> None:
    mpc = clipped_pendulum()
    with pytest.raises(ValueError, match=r"'wide' has observations \(11, 1\).* 2 entries"):
        save_plant_trajectories(tmp_path / "run.png", {"wide": fake([1.0])}, mpc, "s")
