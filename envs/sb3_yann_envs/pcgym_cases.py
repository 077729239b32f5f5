"""The parameters of three plants of PC-Gym, as its authors compare them, and checks of others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Parameters = dict[str, Any]


def _stairs(values: Sequence[float], steps: int) -> list[float]:
    """Return a schedule of ``steps`` entries that holds each value equally long."""
    return [value for value in values for _ in range(steps // len(values))]


def _cstr() -> Parameters:
    """Return the reactor: 26 min in 120 samples, C_A follows its set-point by the jacket."""
    return {
        "model": "cstr",
        "N": 120,
        "tsim": 26.0,
        "SP": {"Ca": _stairs([0.85, 0.9, 0.87], 120)},
        "o_space": {"low": np.array([0.7, 300, 0.8]), "high": np.array([1, 350, 0.9])},
        "a_space": {"low": np.array([295.0]), "high": np.array([302.0])},
        "x0": np.array([0.8, 330, 0.8]),
        "r_scale": {"Ca": 1e3},
    }


def _four_tank() -> Parameters:
    """Return the four tanks: 1,000 s in 60 samples, both upper levels follow set-points."""
    return {
        "model": "four_tank",
        "N": 60,
        "tsim": 1000.0,
        "SP": {"h3": _stairs([0.5, 0.1], 60), "h4": _stairs([0.2, 0.3], 60)},
        "o_space": {"low": np.zeros(6), "high": np.array([0.5] * 6)},
        "a_space": {"low": np.array([0.1, 0.1]), "high": np.array([10.0, 10.0])},
        "x0": np.array([0.141, 0.112, 0.072, 0.42, 0.5, 0.2]),
        "r_scale": {"h3": 1e3, "h4": 1e3},
    }


def _multistage_extraction() -> Parameters:
    """Return the extraction column: 60 h in 60 samples, X5 follows its set-point by two flows."""
    return {
        "model": "multistage_extraction",
        "N": 60,
        "tsim": 60.0,
        "SP": {"X5": _stairs([0.3, 0.4, 0.3], 60)},
        "o_space": {"low": np.array([0.0] * 10 + [0.3]), "high": np.array([1.0] * 10 + [0.4])},
        "a_space": {"low": np.array([5.0, 10.0]), "high": np.array([500.0, 1000.0])},
        "x0": np.array([0.55, 0.3, 0.45, 0.25, 0.4, 0.2, 0.35, 0.15, 0.25, 0.1, 0.3]),
        "r_scale": {"X5": 1e3},
    }


CASES: dict[str, Callable[[], Parameters]] = {
    "cstr": _cstr,
    "four_tank": _four_tank,
    "multistage_extraction": _multistage_extraction,
}
"""Makers of PC-Gym's parameters. Two weights of the error, which PC-Gym has at 1, are 1,000."""

UNITS: dict[str, dict[str, str]] = {
    "cstr": {"Ca": "mol/L", "T": "K", "Tc": "K"},
    "four_tank": {**dict.fromkeys(["h1", "h2", "h3", "h4"], "m"), "v1": "V", "v2": "V"},
    "multistage_extraction": {
        **{f"{phase}{stage}": "kg/m³" for phase in "XY" for stage in range(1, 6)},
        "L": "m³/h",
        "G": "m³/h",
    },
}
"""Units of the states and inputs of PC-Gym's models, by the model's name."""

NEEDED = ("N", "tsim", "SP", "o_space", "a_space", "x0")
NOT_HERE = ("a_delta", "disturbances", "uncertainty_percentages")
"""What PC-Gym adds to theta or to the plant in ways of its own."""


def checked(given: str | Mapping[str, Any]) -> Parameters:
    """Return PC-Gym's parameters, checked, for absolute values and its CasADi integrator."""
    if isinstance(given, str):
        if given not in CASES:
            raise ValueError(
                f"parameters = {given!r} must be one of {sorted(CASES)}, or the mapping that "
                "pcgym.make_env takes."
            )
        given = CASES[given]()
    if not isinstance(given, Mapping):
        raise TypeError(f"parameters = {given!r} must be a name or a mapping.")
    missing = [key for key in NEEDED if key not in given]
    unknown = [key for key in NOT_HERE if given.get(key) is not None]
    if missing or unknown:
        raise ValueError(
            f"parameters lack {missing} and hold {unknown}, which is not supported here. Give what "
            "is missing; for the rest pass a custom_model of the plant as it is."
        )
    return {**given, "normalise_a": False, "normalise_o": False, "integration_method": "casadi"}


def ranges(
    schedules: Mapping[str, ArrayLike], asked: Mapping[str, tuple[float, float]] | None
) -> tuple[Array, Array]:
    """Return the lowest and highest set-points (p,)."""
    asked = {} if asked is None else asked
    unknown = sorted(set(asked) - set(schedules))
    if unknown:
        raise ValueError(f"set_points holds {unknown}; the plant's are {sorted(schedules)}.")
    both = [asked.get(k, (np.min(v), np.max(v))) for k, v in schedules.items()]
    low, high = np.array(both, np.float64).T
    if not np.all(low <= high):  # nor is NaN
        raise ValueError(f"set_points = {dict(asked)} must hold pairs (low, high) in this order.")
    return low, high
