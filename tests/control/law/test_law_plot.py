"""Regions in a plane: the polygons are those of the law."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.control.law_plot import COLORS, REST, area, slices
from sb3_yann_envs import problems


def polygons(axes) -> dict[int, np.ndarray]:
    return {int(patch.get_gid()): patch.get_path().vertices[:-1] for patch in axes.patches}


@pytest.mark.parametrize("entries", [(0, 1), (1, 0)])
def test_what_lies_in_a_polygon_lies_in_its_region(mpc: LinearMPC, entries) -> None:
    law = mpc.explicit()
    drawn = polygons(law.plot(entries=entries))
    point = np.array(mpc.theta_ss)
    assert len(drawn) > 1
    for region, corners in drawn.items():
        for weight in (0.0, 0.9):  # the middle, and near each corner
            for corner in corners:
                point[[*entries]] = weight * corner + (1 - weight) * corners.mean(axis=0)
                assert law.locate(point - mpc.theta_ss) == region


def test_polygons_fill_where_the_mpc_has_a_solution(mpc: LinearMPC) -> None:
    law = mpc.explicit()
    rng = np.random.default_rng(0)
    low = law.theta_min[:2]
    high = law.theta_max[:2]
    theta = np.zeros((4000, law.n_theta))
    theta[:, :2] = rng.uniform(low, high, (len(theta), 2))
    found = slices(law, (0, 1), np.zeros(law.n_theta))
    covered = sum(map(area, found.values())) / np.prod(high - low)
    assert covered == pytest.approx(law.in_domain(theta).mean(), abs=0.03)


def test_other_coordinates_are_where_the_plane_is_cut() -> None:
    mpc = problems.cstr()
    law = mpc.explicit()
    at = np.array(mpc.theta_ss)
    at[3] -= 60.0
    cold = polygons(law.plot(entries=(0, 1), at=at))
    assert [*cold] == [int(law.locate(at - mpc.theta_ss))]
    assert len(polygons(law.plot(entries=(0, 1)))) > 1


def test_a_color_stands_for_one_value_of_the_input() -> None:
    law = problems.clipped_pendulum().explicit()
    axes = law.plot()
    said = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    for value in (2, -2):
        color = said[f"torque = {value} N m"].get_facecolor()
        own = [int(p.get_gid()) for p in axes.patches if p.get_facecolor() == color]
        assert own and all(law.offsets[i] == pytest.approx(value) for i in own)
        assert all(np.abs(law.gains[i]).max() < 1e-9 for i in own)


def test_more_names_than_colors_share_a_gray() -> None:
    law = problems.cstr().explicit()
    numbered = law.plot(entries=(0, 3), name=lambda region, theta: f"own {region}")
    assert len({p.get_facecolor() for p in numbered.patches}) == len(numbered.patches) <= 8
    many = _stripes(np.linspace(-2, 2, 12)).plot(name=lambda region, theta: f"own {region}")
    colors = [to_hex(p.get_facecolor()).upper() for p in many.patches]
    assert sorted(set(colors)) == sorted({*COLORS, REST}) and colors.count(REST) == 4
    assert "4 others" in many.get_legend_handles_labels()[1]


def test_regions_are_numbered_but_for_slivers_and_where_they_are_too_many() -> None:
    some = _stripes(np.array([-2, 0, 0.005, 2])).plot()
    assert {text.get_text() for text in some.texts} == {"0", "2"}
    first, last = (text.get_position() for text in some.texts)
    assert first == pytest.approx((-1, 0)) and last == pytest.approx((1.0025, 0))
    assert len(_stripes(np.linspace(-2, 2, 61)).plot().texts) == 60
    assert not _stripes(np.linspace(-2, 2, 62)).plot().texts


def _stripes(edges: np.ndarray):
    """Return a law with a region between every two edges of the first coordinate."""
    from sb3_yann import PiecewiseAffine

    p = len(edges) - 1
    A = np.tile([[1.0, 0.0], [-1.0, 0.0]], (p, 1))
    b = np.column_stack([edges[1:], -edges[:-1]]).ravel()
    return PiecewiseAffine(
        np.ones((p, 1, 2)), np.zeros((p, 1)), A, b, 2 * np.arange(p), -np.ones(1), np.ones(1),
        np.full(2, -2.0), np.full(2, 2.0), disjoint=True,
    )  # fmt: skip


@pytest.mark.parametrize("entries", [(0, 0), (0, 2), (0,), (0, 1.5)])
def test_entries_that_are_not_two_coordinates_are_refused(entries) -> None:
    with pytest.raises(ValueError, match="two different entries of theta, from 0 to 1"):
        problems.clipped_pendulum().explicit().plot(entries=entries)


def test_a_law_that_is_solved_online_has_no_regions_to_draw() -> None:
    with pytest.raises(ValueError, match=r"has no regions.*plot_surface"):
        problems.clipped_pendulum().online().plot()


def test_a_law_of_one_parameter_is_a_line_over_it() -> None:
    tank = LinearModel([[0.9]], [[0.5]], 1, [12], [3], state_names=["level"], units={"level": "cm"})
    bounds = {"x_min": 0, "x_max": 20, "u_min": 2, "u_max": 4}
    law = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=2, **bounds).explicit()
    axes = law.plot()
    x, u = axes.lines[0].get_data()
    assert (axes.get_xlabel(), axes.get_xlim(), len(axes.patches)) == ("level (cm)", (0, 20), 0)
    np.testing.assert_allclose(u, [law.plant_input([each])[0] for each in x])
    assert len(axes.lines) > 1  # and where regions end


def test_coordinates_are_named_and_shown_as_the_plant_shows_them() -> None:
    mpc = problems.cstr()
    axes = mpc.explicit().plot(entries=("C_A", "T"))
    assert axes.get_xlabel() == "C_A (mol/L)" and axes.get_ylabel() == "T (K)"
    expected = [mpc.theta_min[3] + mpc.model.x_ss[3], mpc.theta_max[3] + mpc.model.x_ss[3]]
    np.testing.assert_allclose(axes.get_ylim(), expected)
    assert mpc.explicit().plot(axes, entries=(0, 3)) is axes
    law = problems.clipped_pendulum().explicit()
    with pytest.raises(ValueError, match=r"\['speed', 'spin'\] must be .*names of angle, speed"):
        law.plot(entries=("speed", "spin"))
