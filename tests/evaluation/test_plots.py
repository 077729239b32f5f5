"""What is printed and drawn of episodes."""

from __future__ import annotations

from io import StringIO

import numpy as np
from matplotlib.image import imread
from rich.console import Console

from sb3_yann.evaluation import Episodes, comparison_table, save_trajectories


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
    assert "-1.00" in text
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
