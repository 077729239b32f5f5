"""What is printed and saved of episodes."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imread

from sb3_yann import LinearModel, LinearMPC, Tracking
from sb3_yann.evaluation import (
    Trajectories,
    comparison_table,
    plots,
    save_plant_trajectories,
    save_trajectories,
)


def fake(costs: list[float]) -> Trajectories:
    steps, count = np.linspace(0, 1, 11)[:, None], len(costs)
    none = np.zeros(count, int)
    return Trajectories(
        np.array(costs), none, (steps,) * count, (steps[1:],) * count, none.astype(bool)
    )


def test_the_table_shows_losses_as_well_as_gains() -> None:
    text = str(comparison_table("costs", fake([10.0, 20.0]), fake([9.0, 27.0])))
    assert all(each in text for each in ("-1.00", "+7.00", "+3.00 (+20.0 %)"))


def test_the_picture_is_a_png_that_shows_something(tmp_path) -> None:
    path = save_trajectories(
        tmp_path / "new folder" / "run", {"before": fake([1.0]), "after": fake([2.0])},
        states={0: "x"}, inputs=["u"], dt=0.1, time_unit="s", limits={0: (0.9, "limit")},
    )  # fmt: skip
    image = imread(path)
    assert path.name == "run.png" and image.shape[0] > 300 and image[..., :3].std() > 0.01


def tank() -> LinearMPC:
    model = LinearModel(
        np.eye(2) / 2, [[1], [0]], 0.5, [12, 3], [40], state_names=["level", "T"],
        input_names=["flow"], units={"T": "K", "flow": "L/s"},
    )  # fmt: skip
    box = {"theta_min": [7, -2], "theta_max": [17, 8], "u_min": 39, "u_max": 41}
    return LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=1, tracking=Tracking([0], 11, 13), **box)


@pytest.mark.parametrize(
    ("options", "labels", "values"),
    [
        ({}, ["level", "T (K)", "flow (L/s)"], [1, 1, 0]),
        (
            {"entries": [1, 2], "labels": {2: "wanted"}},
            ["T (K)", "wanted", "flow (L/s)"],
            [1, 1, 0],
        ),
    ],
)
def test_a_picture_is_in_the_units_of_the_plant_with_its_names(
    options, labels, values, monkeypatch
) -> None:
    x = np.ones((11, 3))
    x[-1, 2] = 9  # the set-point of a step that is not taken
    played = Trajectories(
        np.ones(1), np.zeros(1, int), (x,), (np.zeros((10, 1)),), np.zeros(1, bool)
    )
    monkeypatch.setattr(plots, "save_figure", lambda figure, path, dpi: figure)
    panels = save_plant_trajectories("run.png", {"mpc": played}, tank(), "s", **options).axes
    assert [panel.get_ylabel() for panel in panels] == labels
    assert [panel.lines[0].get_ydata()[0] for panel in panels] == values
    if not options:
        set_point = panels[0].lines[1]
        assert set(set_point.get_ydata()) == {1} and set_point.get_linestyle() == "--"
        assert panels[2].lines[0].get_xdata()[1] == 0.5


def test_observations_that_are_not_theta_are_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"'wide' has observations \(11, 1\).* 3 entries"):
        save_plant_trajectories(tmp_path / "run.png", {"wide": fake([1.0])}, tank(), "s")
