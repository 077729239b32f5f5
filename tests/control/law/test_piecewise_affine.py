"""A law is defined everywhere, bounded, knows its plant, and survives files and copies."""

import copy
import dataclasses
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from errors import Message, raises
from random_problems import edges
from sample_problems import solved, strips
from sb3_yann import LinearModel, LinearMPC, RateLimits, Tracking
from sb3_yann._archive import read_arrays, write_arrays
from sb3_yann.control import DisturbanceBounds, OnlineLaw, PiecewiseAffine
from sb3_yann.control.gains import Gains
from sb3_yann.control.law_plot import area, slices
from sb3_yann_envs import problems

PLANAR = ["pendulum", "benchmark", "asymmetric input bounds", "two inputs", "terminal set"]


@cache
def law_of(name: str, infeasible: str = "nearest_region") -> PiecewiseAffine:
    return dataclasses.replace(solved(name).explicit(), infeasible=infeasible)


def far_points(law: PiecewiseAffine, seed: int = 0) -> np.ndarray:
    """Points (count, n) of every size from 1e-6 to 1e6 boxes, and on the axes."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(2000, law.n_theta)) * 10 ** rng.uniform(-6, 6, (2000, 1))
    axes = np.kron([1e6, -1e6, 0.0], np.eye(law.n_theta)).T
    return np.vstack([points, axes]) * (law.theta_max - law.theta_min)


@cache
def special_points(name: str) -> np.ndarray:
    law = law_of(name)
    corners = slices(law, (0, 1), np.zeros(2)).values() if law.n_theta == 2 else ()
    return np.vstack([edges(law, seed=0)[0], *corners])


@pytest.mark.parametrize("name", [*PLANAR, "reactor", "states of 1e-9 and 1e7, inputs of 1e6"])
def test_facets_and_vertices_belong_to_the_domain(name: str) -> None:
    points = special_points(name)
    assert len(points) > 10
    assert law_of(name).in_domain(points).all()


@pytest.mark.parametrize("batch", [(), (5,), (0,)])
def test_shapes_follow_those_of_theta(batch: tuple[int, ...]) -> None:
    law = law_of("two inputs")
    theta = np.zeros((*batch, 2))
    assert law(theta).shape == (*batch, 2)
    assert np.shape(law.locate(theta)) == np.shape(law.in_domain(theta)) == batch


def test_nearest_is_the_clipped_law_of_the_region_violated_least() -> None:
    law = law_of("terminal set")
    points = far_points(law)
    infeasible = points[~law.in_domain(points)]
    assert len(infeasible) > 100
    i = law.locate(infeasible)
    affine = np.einsum("bmn,bn->bm", law.gains[i], infeasible) + law.offsets[i]
    np.testing.assert_array_equal(law(infeasible), np.clip(affine, -1, 1))


@pytest.mark.parametrize(("u_min", "value"), [(-0.2, 0.0), (0.2, 0.2)])
def test_zero_is_no_input_outside_or_the_bound_nearest_to_it(u_min: float, value: float) -> None:
    law = law_of("asymmetric input bounds", "zero_input")
    law = dataclasses.replace(law, u_min=np.array([u_min]))
    points = far_points(law)
    infeasible = points[~law.in_domain(points)]
    assert len(infeasible) > 100
    np.testing.assert_array_equal(law(infeasible), value)


@pytest.mark.parametrize(
    "name", ["benchmark", "reactor", "four states, two inputs", "zero input not allowed"]
)
def test_beyond_the_box_regions_go_on_as_the_online_law_does(name: str) -> None:
    law = law_of(name)
    rng = np.random.default_rng(0)
    beyond = law.theta_max + 0.3 * rng.uniform(size=(500, law.n_theta)) * law.theta_max
    beyond = beyond * rng.choice([-1.0, 0.3, 1.0], size=beyond.shape)
    assert np.mean(np.any((beyond < law.theta_min) | (beyond > law.theta_max), axis=1)) > 0.5
    off = np.abs(law(beyond) - solved(name).online()(beyond))
    assert np.mean(off.max(axis=1) < 1e-9) > 0.99
    assert off.max() < 0.01
    assert not law.in_domain(law.theta_max * 1.01)  # nothing was proved there


def test_a_region_that_ends_at_the_box_alone_holds_everywhere() -> None:
    law = law_of("nothing bounded")
    np.testing.assert_allclose(law(far_points(law)), far_points(law) @ law.gains[0].T)


def test_a_facet_is_no_end_of_a_box_that_is_open_on_one_side() -> None:
    law = PiecewiseAffine(
        gains=[[[-1.0]], [[1.0]]], offsets=[[0.0], [0.0]], A=[[1.0], [-1.0]], b=[2.0, -2.0],
        starts=[0, 1], u_min=[-9.0], u_max=[9.0], theta_min=[-np.inf], theta_max=[5.0],
    )  # fmt: skip
    np.testing.assert_array_equal(law([[1.0], [3.0], [-4.0]]), [[-1.0], [3.0], [4.0]])


def arrays_with(**changes: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        law = law_of("pendulum")
        values = {field.name: getattr(law, field.name) for field in dataclasses.fields(law)}
        write_arrays(path, {**values, **changes})

    return write


GARBAGE: dict[str, Callable[[Path], Any]] = {
    "text": lambda path: path.write_text("garbage"),
    "another archive": lambda path: np.savez(path.open("wb"), gains=np.eye(2)),
    "NaN": arrays_with(offsets=np.full((7, 1), np.nan)),
    "words": arrays_with(b=np.full(32, "one")),
    "gains of another shape": arrays_with(gains=np.zeros((7, 2))),
    "rows that do not exist": arrays_with(starts=np.arange(7) + 100),
    "rows out of order": arrays_with(starts=np.array([0, 4, 2, 8, 12, 16, 20])),
    "no region": arrays_with(gains=np.zeros((0, 1, 2)), offsets=np.zeros((0, 1)), starts=[]),
    "crossed bounds": arrays_with(u_min=np.array([3.0])),
    "an unknown option": arrays_with(infeasible="mean"),
}


@pytest.mark.parametrize("content", GARBAGE)
@pytest.mark.filterwarnings("ignore:unclosed file")  # the writer of "another archive"
def test_file_that_holds_no_law_is_a_value_error(content: str, tmp_path: Path) -> None:
    path = tmp_path / "law.npz"
    GARBAGE[content](path)
    with pytest.raises(
        ValueError, match=r"(?s)law\.npz does not hold a PiecewiseAffine .*law\.save"
    ):
        PiecewiseAffine.load(path)


COPIES = [copy.copy, copy.deepcopy, lambda law: pickle.loads(pickle.dumps(law))]


@pytest.mark.parametrize("copied", [lambda law: law, *COPIES])
@pytest.mark.parametrize("name", ["gains", "starts", "theta_max"])
def test_arrays_are_read_only_in_every_copy(name: str, copied: Any) -> None:
    array = getattr(copied(law_of("pendulum")), name)
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 0


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(PiecewiseAffine) if f.compare])
def test_laws_that_differ_in_one_field_are_not_equal(name: str) -> None:
    law = law_of("pendulum")
    value = {"infeasible": "zero_input", "disjoint": False}.get(name)
    if value is None:
        value = getattr(law, name) + 0
        value.flat[-1] += 1 if name == "starts" else 1e-3
    assert dataclasses.replace(law, **{name: value}) != law


BAD_THETA: list[tuple[Any, Message]] = [
    ([1.0], r"theta has shape \(1,\), expected \(2,\) or \(batch, 2\)"),
    (1.0, r"theta has shape \(\), expected \(2,\)"),
    (np.zeros((2, 2, 2)), r"theta has shape \(2, 2, 2\), expected"),
    ([np.nan, 0], "theta holds NaN or infinite"),
    ([[0, 0], [np.inf, 0]], "theta holds NaN or infinite"),
    (["a", "b"], TypeError("theta = .* is not an array of real numbers")),
    (np.array([1j, 0]), TypeError("theta = .* is not an array of real numbers")),
    (np.ma.array([1.0, 0.0], mask=[1, 0]), "theta has masked entries"),
]


@pytest.mark.parametrize(("theta", "message"), BAD_THETA)
def test_theta_that_is_no_point_or_batch_is_named(theta: Any, message: Message) -> None:
    for call in ("__call__", "locate", "in_domain"):
        with raises(message):
            getattr(law_of("pendulum"), call)(theta)


KINDS: dict[str, Any] = {"explicit": PiecewiseAffine, "online": OnlineLaw}


def reactor() -> LinearMPC:
    model = LinearModel(
        [[0.9, 0.1], [0.0, 0.8]], [[0.0], [0.5]], dt=0.1, x_ss=[2, 350], u_ss=[40],
        E=[[0.1], [0.0]], d_ss=[7], disturbance_names=["feed"],
        state_names=["conversion", "temperature"], input_names=["coolant"],
        units={"temperature": "K"}, gains=Gains.of(0.8 * np.eye(2), np.ones((2, 1))),
    )  # fmt: skip
    return LinearMPC(
        model, Q=np.eye(2), R=[[0.1]], horizon=3,
        x_min=[0, 340], x_max=[4, 360], u_min=35, u_max=46,
        tracking=Tracking([1], 345, 355), disturbances=DisturbanceBounds(6, 8),
        rate=RateLimits(-2, 2),
    )  # fmt: skip


@pytest.fixture(params=KINDS)
def saved(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Any, Path, Any]:
    law = getattr(reactor(), request.param)()
    law.save(tmp_path / "law.npz")
    return law, tmp_path / "law.npz", KINDS[request.param]


def test_a_file_holds_operating_point_sampling_time_names_and_units(saved: Any) -> None:
    law, path, kind = saved
    model = reactor().model
    for read in (kind.load(path), pickle.loads(pickle.dumps(law))):
        assert read == law and read.model == model and not read.theta_ss.flags.writeable
        for name in ("dt", "state_names", "input_names", "disturbance_names", "units"):
            assert getattr(read.model, name) == getattr(model, name)
        assert read.theta_ss.tolist() == [2, 350, 350, 7, 40]


def test_the_plant_takes_what_the_law_says_of_what_it_shows(saved: Any) -> None:
    law, path, kind = saved
    shown = np.array([[2.5, 351, 352, 6.5, 41], [2, 350, 350, 7, 40]])
    u = kind.load(path).plant_input(shown)
    assert np.array_equal(u, law(shown - [2, 350, 350, 7, 40]) + 40)
    assert u[1] == pytest.approx(40) and abs(u[0] - 40) > 0.1


def test_a_file_without_a_plant_is_a_law_without_one(saved: Any) -> None:
    law, path, kind = saved
    arrays = read_arrays(path)
    own = {k: v for k, v in arrays.items() if k != "theta_ss" and not k.startswith("model_")}
    write_arrays(path, own)
    read = kind.load(path)
    assert read == law and read.model is None
    with pytest.raises(ValueError, match="knows no operating point"):
        read.plant_input([2, 350, 350, 7, 40])


@pytest.mark.parametrize(
    "damage",
    [{"model_A": np.eye(3)}, {"model_x_ss": [2.0, np.nan]}, {"theta_ss": [1.0]}, {"model_dt": 0.0},
     {"model_state_names": ["a", "a"]},
     {"model_B": np.ones((2, 2)), "model_u_ss": [0.0, 0.0], "model_input_names": [],
      "model_units": []}],
    ids=lambda damage: "-".join(damage),
)  # fmt: skip
def test_a_damaged_plant_is_a_value_error(saved: Any, damage: dict[str, Any]) -> None:
    _, path, kind = saved
    write_arrays(path, {**read_arrays(path), **damage})
    with pytest.raises(ValueError, match=r"law\.npz does not hold"):
        kind.load(path)


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


def test_regions_are_numbered_but_for_slivers_and_where_they_are_too_many() -> None:
    some = strips(np.array([-2, 0, 0.005, 2])).plot()
    assert {text.get_text() for text in some.texts} == {"0", "2"}
    first, last = (text.get_position() for text in some.texts)
    assert first == pytest.approx((-1, 0)) and last == pytest.approx((1.0025, 0))
    assert len(strips(np.linspace(-2, 2, 61)).plot().texts) == 60
    assert not strips(np.linspace(-2, 2, 62)).plot().texts


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
    with pytest.raises(ValueError, match=r"\['speed', 'spin'\] must be .*names of angle, speed"):
        problems.clipped_pendulum().explicit().plot(entries=("speed", "spin"))
