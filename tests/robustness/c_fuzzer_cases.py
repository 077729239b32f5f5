"""What is exported and fuzzed, and what must hold of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_yann import Checks, Controller, LinearModel, LinearMPC, export
from sb3_yann.deployment.code import literal, table

HERE = Path(__file__).parent
ROOM = {"double": 1e-9, "float": 2e-5}
"""How far an output may be beyond a bound, in parts of the input's range."""


@dataclass(frozen=True)
class Case:
    """What is exported, and how."""

    make: Callable[[], Any]
    options: dict[str, Any] = field(default_factory=dict)
    tested: bool = True
    """Whether its self-test must pass."""


def cases() -> dict[str, Case]:
    """Return the ten kinds of policies of the tests, a law without bounds and an MPC with rates."""
    from torch import nn

    import deployed
    import general_problems
    import sample_laws

    def unbounded() -> LinearMPC:
        model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
        return LinearMPC(
            model, Q=np.eye(2), R=[[0.1]], horizon=3, x_min=[-5, -2], x_max=[5, 2]
        )  # fmt: skip

    found = {name: Case(lambda n=name: deployed.policy_of(n)) for name in deployed.CASES}
    found["no bounds of the inputs"] = Case(unbounded)
    found["an MPC with rates"] = Case(lambda: general_problems.solved("servo with rates"))
    found["networks that overflow"] = Case(
        lambda: deployed.disturbed(sample_laws.solved("reactor"), size=1e25, activation_fn=nn.ReLU),
        tested=False,
    )
    return found


def checks_of(number: int, rest: Any, half: Any) -> Checks:
    """Return the checks of the case of a number: by default, strict, or none at all in between."""
    if number % 3 == 0:
        return Checks()
    if number % 3 == 1:
        low, high = rest - 1.5 * half, rest + 1.5 * half
        return Checks(low, high, frozen_after=3, hold=2, recover=2, transfer=3)
    return Checks(frozen_after=1, hold=0, recover=0, transfer=0, late_after=None)


def limits(data: dict[str, Any], precision: str, tested: bool) -> str:
    """Return fuzz_limits.h: what must hold, taken from the controller in Python."""
    m, rated = len(data["action_scale"]), len(data["change"]) > 0
    scale, shift = data["action_scale"], data["action_shift"]
    low, high = np.sort(data["bounds"] * scale + shift, axis=0)
    middle, half = box_of(data)
    bounded = np.isfinite(low) & np.isfinite(high)
    span = np.where(bounded, high - low, 2 * scale)
    numbers = {
        "lowest": low, "highest": high, "range_of": span,
        "room": ROOM[precision] * (span + np.abs(shift)),
        "middle": middle, "half": half,
        "reading_min": data["obs_min"], "reading_max": data["obs_max"],
    }  # fmt: skip
    if rated:  # what the env shows of an output: output * shown_per + shown_at
        assert np.array_equal(data["obs_matrix"], np.eye(len(middle)))
        per = 1 / (scale * data["per_input"])
        numbers["change_min"], numbers["change_max"] = data["change"] * scale
        numbers["shown_per"] = per
        numbers["shown_at"] = data["middle"] / data["per_input"] - shift * per
        numbers["shown_at"] = numbers["shown_at"] - data["obs_offset"][-m:]
    flags: dict[str, Any] = {
        "MOST": "FLT_MAX" if precision == "float" else "DBL_MAX",
        "LEAST": "1e-45f" if precision == "float" else "5e-324",
        "LATE_AFTER": literal(float(data["late_after"]), precision),
        **{name.upper(): int(data[name]) for name in ("frozen_after", "hold", "recover")},
        "TRANSFER": int(data["transfer"]),
        "RATED": int(rated),
        "TESTED": int(tested),
        "READS_THETA": int(np.array_equal(data["obs_matrix"], np.eye(len(middle)))),
        "UNBOUNDED": int(not bounded.all()),
    }
    lines = [f"#define {name} {value}" for name, value in flags.items()]
    real = np.float32 if precision == "float" else np.float64
    lines += [
        table("plant_real", name, np.asarray(each, real), precision)
        for name, each in numbers.items()
    ]
    return "\n".join([*lines, ""])


def box_of(data: dict[str, Any]) -> tuple[Any, Any]:
    """Return the middle and the half-widths of the readings (n_obs,) in the box of theta."""
    low, high = data["box"]
    back = np.linalg.pinv(data["obs_matrix"])
    half = np.abs(back) @ ((high - low) / 2)
    return back @ ((low + high) / 2 - data["obs_offset"]), np.where(half > 0, half, 1.0)


def write(case: Case, number: int, precision: str, folder: Path) -> None:
    """Export a case with the checks of its number, and write what must hold of it."""
    given = case.make()
    export(given, folder / "plant.npz", **case.options)
    own = checks_of(number, *box_of(Controller.load(folder / "plant.npz").data))
    export(given, folder / "plant.npz", checks=own, **case.options)
    export(given, folder / "plant.c", checks=own, precision=precision, **case.options)
    data = Controller.load(folder / "plant.npz").data
    (folder / "fuzz_limits.h").write_text(limits(data, precision, case.tested))
    shutil.copy(HERE / "fuzz_target.c", folder)
