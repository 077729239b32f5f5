"""Tables, closed loops, surfaces, and what a policy does in each region: what is drawn."""

from dataclasses import replace

import numpy as np
import pytest

from sample_laws import reactor_in_plant_units
from sb3_yann import LinearModel, LinearMPC, Tracking
from sb3_yann.evaluation import Trajectories, comparison_table, evaluate
from sb3_yann.evaluation.plots import loops_figure, plot_gains, plot_surface, use_figure
from sb3_yann_envs import problems


def tank(**options) -> LinearMPC:
    model = LinearModel(
        [[0.9]], [[0.5]], 2.0, [12], [40], state_names=["level"], input_names=["flow"],
        units={"level": "m", "flow": "L/s"}, time_unit="s",
    )  # fmt: skip
    given = {"x_min": 9, "x_max": 15, "theta_min": 8, "theta_max": 16}
    limits = {"u_min": 39, "u_max": 41, "horizon": 2}
    return LinearMPC(model, Q=[[1]], R=[[1]], **{**given, **limits, **options})


def episodes(count: int, size: int = 1, steps: int = 5) -> Trajectories:
    x = [np.full((steps + 1, size), 12 + k / count) for k in range(count)]
    u = [np.full((steps, 1), 40 - k / count) for k in range(count)]
    none = np.zeros(count, int)
    return Trajectories(np.ones(count), none, tuple(x), tuple(u), none.astype(bool))


def plot_loop(mpc, runs, quantity, **options):
    return loops_figure(mpc, runs, quantities=[quantity], **options).axes[0]


def test_the_table_shows_losses_as_well_as_gains() -> None:
    before = episodes(2)
    after = episodes(2)
    before.costs[:] = 10.0, 20.0
    after.costs[:] = 9.0, 27.0
    text = comparison_table("costs", before, after, names=("PI", "after"))
    assert all(each in text for each in ("PI  ", "-1.00", "+7.00", "  +20.00 %", "+46.67 %"))
    assert not any(each in text for each in ("observations have", "soft bounds", "ended"))
    paid = replace(before, penalty=np.array([1.0, 3.0]), terminated=np.array([True, False]))
    assert "ended        0 by the env before their time, MPC 1" in comparison_table("", paid, after)
    assert "soft bounds  0 instead of 2 an episode" in comparison_table("", paid, after)
    assert "observations have 1 and 2 entries" in comparison_table("", before, episodes(2, size=2))


def test_few_episodes_are_lines_in_plant_units() -> None:
    axes = plot_loop(tank(), {"MPC": episodes(3)}, "level")
    own = [line for line in axes.lines if len(line.get_ydata()) == 6]
    np.testing.assert_allclose([line.get_ydata()[0] for line in own], [12, 12 + 1 / 3, 12 + 2 / 3])
    assert own[0].get_xdata().tolist() == [0, 2, 4, 6, 8, 10]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "level (m)")


def test_a_set_point_is_a_line_of_its_own_without_the_last_one() -> None:
    mpc = tank(tracking=Tracking([0], 10, 14))
    played = episodes(2, size=2)
    for x in played.observations:
        x[:, 1] = 13.0
        x[-1, 1] = 21.0
    axes = plot_loop(mpc, {"MPC": played}, "level")
    (line,) = (each for each in axes.lines if each.get_label() == "set-point")
    assert set(line.get_ydata()) == {13.0}


def test_gains_are_sorted_and_in_percent_of_the_first_one_s_mean() -> None:
    before = episodes(3)
    after = episodes(3)
    after.costs[:] = 0.5, 1.5, 0.25
    axes = plot_gains({"MPC": before, "policy": after})
    assert [bar.get_height() for bar in axes.patches] == [-75, -50, 50]
    assert axes.get_ylabel() == "policy minus MPC\n(% of MPC's mean cost)"


def test_what_is_no_quantity_and_no_episodes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'depth' is no entry: expected one of \['level', 'flow'"):
        plot_loop(tank(), {"MPC": episodes(1)}, "depth")
    with pytest.raises(ValueError, match="no episodes to draw"):
        plot_loop(tank(), {}, "level")
    with pytest.raises(ValueError, match=r"'MPC' has observations \(6, 3\)"):
        plot_loop(tank(), {"MPC": episodes(1, size=3)}, "level")


def test_the_surface_is_the_law_in_plant_units() -> None:
    mpc = reactor_in_plant_units()
    axes = plot_surface(mpc, mpc.explicit(), entries=("C_B", "T"))
    (mesh,) = axes.collections
    corners = mesh.get_coordinates()
    middle = (corners[40, 60] + corners[41, 61]) / 2
    shown = np.array(mpc.theta_ss)
    shown[[1, 3]] = middle
    values = np.asarray(mesh.get_array()).reshape(121, 121)
    assert values[40, 60] == pytest.approx(mpc.explicit().plant_input(shown)[0])
    assert values.min() == pytest.approx(0, abs=1e-9) and values.max() == pytest.approx(110)


def test_use_counts_steps_and_distances_by_region() -> None:
    mpc = problems.cstr()
    law = mpc.explicit()
    played = evaluate(mpc.explicit(), "CSTR-v0", range(2))
    moved = lambda theta: np.clip(law(theta) + 5.5, -55, 55)  # noqa: E731
    theta = np.concatenate([x[:-1] for x in played.observations])
    regions, counts = np.unique(law.locate(theta), return_counts=True)
    order = np.argsort(-counts, kind="stable")
    above, below = use_figure(mpc, moved, played).axes
    named = [int(each.get_text()) for each in below.get_xticklabels()]
    assert named == regions[order].tolist()
    shares = 100 * counts[order] / len(theta)
    np.testing.assert_allclose([bar.get_height() for bar in above.patches], shares)
    online = problems.cstr()
    online.law("online")
    with pytest.raises(ValueError, match=r"no regions\. Call explicit\(\)"):
        use_figure(online, moved, played)
    largest = below.lines[0].get_ydata()
    assert max(largest) == pytest.approx(10)  # of half the range
    assert all(bar.get_height() <= top for bar, top in zip(below.patches, largest, strict=True))
