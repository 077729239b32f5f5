"""A law knows its plant: operating point, dt, names and units, in memory and in its file."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC, RateLimits, Tracking
from sb3_yann._archive import read_arrays, write_arrays
from sb3_yann.control import DisturbanceBounds, OnlineLaw, PiecewiseAffine

KINDS: dict[str, Any] = {"explicit": PiecewiseAffine, "online": OnlineLaw}


def reactor() -> LinearMPC:
    model = LinearModel(
        [[0.9, 0.1], [0.0, 0.8]], [[0.0], [0.5]], dt=0.1, x_ss=[2, 350], u_ss=[40],
        E=[[0.1], [0.0]], d_ss=[7],
        state_names=["conversion", "temperature"], input_names=["coolant"],
        units={"temperature": "K"},
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
    model, read = reactor().model, kind.load(path)
    assert read == law and read.model == model
    for name in ("dt", "state_names", "input_names", "units"):
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


def test_a_pickle_keeps_the_plant(saved: Any) -> None:
    copy = pickle.loads(pickle.dumps(saved[0]))
    assert copy.model == reactor().model and not copy.theta_ss.flags.writeable
