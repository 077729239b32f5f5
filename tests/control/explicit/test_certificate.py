"""An explicit solution that is wrong never leaves `explicit()`: the error names a theta."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from online_mpc import OnlineMPC
from sample_problems import PROBLEMS, solved
from sb3_yann.control import ExplicitSolutionError
from sb3_yann.control.explicit import solve as module

Regions = list[Any]
THIN = "a final state held to 1e-4"
DROPS = {"pendulum": 7, THIN: 15}


def error_of(
    monkeypatch: pytest.MonkeyPatch, name: str, spoil: Callable[[Regions], Regions]
) -> tuple[str, np.ndarray]:
    """Solve with spoilt regions; return the error's message and the theta that it names."""
    with monkeypatch.context() as patch:
        find = module.critical_regions
        patch.setattr(module, "critical_regions", lambda *args: spoil(find(*args)))
        with pytest.raises(ExplicitSolutionError, match="failed its check: ") as error:
            PROBLEMS[name]().explicit()
    theta = re.search(r"theta = (\[.*?\])", str(error.value))
    assert theta is not None
    return str(error.value), np.array(ast.literal_eval(theta.group(1)))


def with_changed_gain(regions: Regions, index: int, factor: float) -> Regions:
    changed = dataclasses.replace(regions[index], gain=regions[index].gain * factor + factor - 1)
    return [*regions[:index], changed, *regions[index + 1 :]]


@pytest.mark.parametrize(
    ("name", "index"), [(name, i) for name, count in DROPS.items() for i in range(count)]
)
def test_a_dropped_region_is_found_and_theta_lies_in_it(
    name: str, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    message, theta = error_of(monkeypatch, name, lambda found: found[:index] + found[index + 1 :])
    assert "no region covers a feasible parameter" in message
    assert solved(name).explicit().locate(theta) == index


@pytest.mark.parametrize(("name", "index"), [("pendulum", 0), ("pendulum", 6), ("reactor", 3)])
def test_a_gain_off_by_a_thousandth_is_found(
    name: str, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    message, theta = error_of(
        monkeypatch, name, lambda found: with_changed_gain(found, index, 1.001)
    )
    assert f"the law of region {index} is not optimal inside it" in message
    assert solved(name).explicit().locate(theta) == index


@pytest.mark.parametrize("beyond", [3e-9, 9e-9])
def test_a_region_that_reaches_a_hair_too_far_is_trimmed(
    beyond: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = solved("benchmark").explicit()
    find = module.critical_regions

    def spoil(*args: Any) -> Regions:
        first, *rest = find(*args)
        inner = np.all(np.abs(first.A) < 0.999, axis=1)  # not a bound of theta
        return [dataclasses.replace(first, b=first.b + beyond * inner), *rest]

    monkeypatch.setattr(module, "critical_regions", spoil)
    law = PROBLEMS["benchmark"]().explicit()
    assert law.n_regions == right.n_regions
    more = len(law.b) - len(right.b)
    assert more > 0 and len(law.neighbors) == len(law.b)
    # The true conditions of the region are among its half-spaces again, with what lies beyond.
    own, known = (each.starts[1] for each in (law, right))
    for k in range(known):
        off = np.abs(law.A[:own] - right.A[k]).max(axis=1) + np.abs(law.b[:own] - right.b[k])
        (same,) = np.flatnonzero(off < 1e-12)
        assert law.neighbors[same] == right.neighbors[k]
    np.testing.assert_array_equal(law.A[own:], right.A[known:])


def test_a_region_that_is_there_twice_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    message, theta = error_of(monkeypatch, "benchmark", lambda regions: [*regions, regions[3]])
    assert "region 3 and region 9 are the same" in message
    assert solved("benchmark").explicit().locate(theta) == 3


@pytest.mark.parametrize("gap", [1e-3, 1e-6])
@pytest.mark.parametrize("name", ["benchmark", "reactor"])
def test_a_thin_gap_between_two_regions_is_found(
    name: str, gap: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(regions: Regions) -> Regions:
        inner = np.all(np.abs(regions[0].A) < 0.999, axis=1)  # not a bound of theta
        b = regions[0].b - gap * inner * (np.cumsum(inner) == 1)
        return [dataclasses.replace(regions[0], b=b), *regions[1:]]

    message, theta = error_of(monkeypatch, name, spoil)
    assert "no region covers a feasible parameter" in message
    assert OnlineMPC(solved(name))(theta) is not None


@pytest.mark.parametrize("reach", [1e-2, 1e-5])
@pytest.mark.parametrize("index", [0, 3])
def test_one_half_space_that_reaches_a_little_too_far_is_found(
    index: int, reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(regions: Regions) -> Regions:
        b = regions[index].b.copy()
        b[0] += reach
        return [*regions[:index], dataclasses.replace(regions[index], b=b), *regions[index + 1 :]]

    message, _ = error_of(monkeypatch, "benchmark", spoil)
    assert f"the law of region {index} violates the KKT conditions" in message


def test_the_regions_of_ppopt_are_checked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    find = module.critical_regions
    monkeypatch.setattr(module, "critical_regions", lambda *args: find(*args)[1:])
    with pytest.raises(ExplicitSolutionError, match="no region covers a feasible parameter"):
        PROBLEMS["benchmark"]().explicit("ppopt")


def test_finding_no_region_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    message, _ = error_of(monkeypatch, "benchmark", lambda regions: [])
    assert "no region was found" in message


def test_a_failed_check_is_not_kept_as_a_law(monkeypatch: pytest.MonkeyPatch) -> None:
    mpc = PROBLEMS["benchmark"]()
    with monkeypatch.context() as patch:
        patch.setattr(module, "critical_regions", lambda *args: [])
        with pytest.raises(ExplicitSolutionError):
            mpc.explicit()
    assert mpc.explicit().n_regions == 9
