"""What all code of a controller has in common: precision, tables, their cost, known answers."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.deployment.controller import Controller, steps_of

ControllerArrays = Mapping[str, Any]
Tables = dict[str, NDArray[Any]]
ROOM = {"double": 1e-12, "float": 1e-5}
"""How far exported code may be off, in parts of an input's range, by its precision."""


def room_of(data: ControllerArrays, precision: str, inside: bool = True) -> float:
    """Return how far code of a controller may be off, in parts of an input's range."""
    if "qp_gram" not in data:
        return ROOM[precision]
    if not inside:
        return 1e-6  # constraints that give way cost digits
    # Multipliers of steep soft bounds lose the digits that their effect on the inputs is large by.
    return 1e-9 * max(1.0, float(np.abs(data["qp_E"]).max(initial=0.0)) / 10)


def scale_within(
    scale: Array, shift: Array, low: Array, high: Array, real: Any = np.float64
) -> NDArray[Any]:
    """Return the scale (m,), up to 7 roundings smaller so that outputs keep their bounds.

    Outputs are ``scale * y + shift``, computed as ``real``, for y in [-1, 1]; their bounds are
    ``low`` and ``high``. Where these have no room for that, in float32 beside a huge operating
    point, the scale stays.
    """
    found = scale.astype(real)
    middle = shift.astype(real)
    step = np.spacing(np.maximum(found, np.abs(middle)))
    tried = found - np.arange(8)[:, None].astype(real) * step
    inside = (middle - tried >= low) & (middle + tried <= high) & (tried > 0)
    best = np.take_along_axis(tried, inside.argmax(0)[None], 0)[0]
    return np.where(inside.any(0), best, found)


def action_scale(data: ControllerArrays, precision: str) -> NDArray[Any]:
    """Return the scale of a controller's outputs for code of that precision."""
    scale = data["action_scale"]
    shift = data["action_shift"]
    if precision == "double":
        return np.asarray(scale)
    return scale_within(scale, shift, shift - scale, shift + scale, np.float32)


def search_tolerances(data: ControllerArrays, precision: str) -> dict[str, float]:
    """Return the tolerances of a search for a region, in half-widths of the box of theta.

    ``tolerance``: so far outside, a point counts as inside. ``tie``: slacks that differ by less,
    relative to 1 + their size, tie. The others are those of the law's own compiled search. In float
    they are coarser: a slack is known to some 1e-6.
    """
    own = (*map(float, data["tolerances"]), 1e-9, 1e-9)
    found = (1e-5, 2e-6, 1e-5, 1e-5) if precision == "float" else own
    return dict(zip(("tolerance", "tie", "surely_inside", "back"), found, strict=True))


# ---- Tables ----


def controller_tables(
    data: ControllerArrays, precision: str, walk: bool = True
) -> tuple[Tables, Tables]:
    """Return the tables of numbers and those of indices, by their names; a walk's are last."""
    same = "A b box_middle box_per_half gains offsets obs_matrix obs_offset obs_rest resting"
    same += " obs_min obs_max action_shift"
    numbers: Tables = {name: data[name] for name in same.split()}
    numbers["action_scale"] = action_scale(data, precision)
    numbers["input_min"], numbers["input_max"] = data["bounds"]
    numbers["theta_min"], numbers["theta_max"] = data["ends"]
    starts = np.array([*data["starts"], len(data["b"])])
    indices: Tables = {"starts": starts, "watched": data["watched"].astype(np.int64)}
    indices |= {"source": data["source"], "missing": data["missing"]}
    if "est_gain" in data:
        names = ("est_next", "est_rest", "est_first", "est_C", "est_gain")
        numbers |= {name: data[name] for name in names}
        numbers["input_scale"], numbers["input_shift"] = data["est_input"]
        numbers["est_min"], numbers["est_max"] = data["est_box"]
        if len(data["est_loads"]):
            indices["est_loads"] = data["est_loads"]
    if len(data["change"]):
        numbers["change_min"], numbers["change_max"] = data["change"]
    if len(data["moving"]):
        indices["moving_min"], indices["moving_max"] = data["moving"]
    if len(data["change"]) or len(data["moving"]):
        numbers |= {"per_input": data["per_input"], "middle": data["middle"]}
    if "qp_gram" in data:
        numbers |= {name: data[name] for name in ("qp_D", "qp_d0", "qp_gram", "qp_E")}
        numbers["qp_softness"] = data["qp_softness"]
        if len(data["qp_fixed"]):
            numbers["qp_fixed"] = data["qp_fixed"]
    if len(data["pinned"]):
        last = int(data["n_layers"]) - 1
        numbers |= {f"layer{i}": data[f"layer{i}"] for i in range(last)}
        numbers |= {"last_layer": data[f"layer{last}"], "per_theta": data["per_theta"]}
        numbers["confine_middle"], numbers["confine_per_half"] = data["confines"]
        if len(data["kept"]):
            numbers["kept"] = data["kept"]
        indices |= {"network_of": data["network_of"], "pinned": data["pinned"].astype(np.int64)}
    if walk and data["neighbors"].size:
        numbers["walk_slack"] = data["walk_slack"]
        indices["neighbors"] = data["neighbors"]
    return numbers, indices


def index_bytes(indices: Tables) -> int:
    """Return the bytes that indices need: 2 or 4."""
    return 2 if max(int(np.abs(each).max()) for each in indices.values()) < 2**15 else 4


@dataclass(frozen=True)
class Cost:
    """What a controller needs at worst."""

    numbers: int  # entries of its tables
    indices: int
    index_bytes: int
    multiplications: int  # of a step, each with an addition: its search asks every region twice
    activations: int  # of a step
    locals: int  # numbers that a step keeps on the stack

    @classmethod
    def of(cls, data: ControllerArrays) -> Cost:
        """Return the cost of a controller's arrays."""
        numbers, indices = controller_tables(data, "double")
        (_, m, n) = data["gains"].shape
        n_obs = data["obs_matrix"].shape[1]
        widths = [data[f"layer{i}"].shape[1] for i in range(int(data["n_layers"]))]
        hidden = sum(widths[:-1])
        products = n * n_obs + m * (n + 2)
        products += n + (3 if data["neighbors"].size else 2) * len(data["b"]) * n  # the search
        filters = "est_next", "est_C", "est_gain"
        products += sum(data[name].size for name in filters if name in data)
        if widths:
            products += 2 * n + 2 * data["kept"].size
            products += sum(a * b for a, b in zip([n, *widths], widths, strict=False))
        if "qp_gram" in data:
            rows = len(data["qp_d0"])
            most = int(data["qp_most"])
            products += rows * n + steps_of(data) * most * (rows + 2 * most)
        return cls(
            numbers=sum(each.size for each in numbers.values()),
            indices=sum(each.size for each in indices.values()),
            index_bytes=index_bytes(indices),
            multiplications=products,
            activations=2 * hidden,
            locals=2 * n + 8 * m + hidden + 8 + 2 * n_obs,
        )

    def __str__(self) -> str:
        double, single = (
            (self.numbers * size + self.indices * self.index_bytes) / 1000 for size in (8, 4)
        )
        return (
            f"tables: {self.numbers} numbers and {self.indices} indices ({double:.1f} kB double, "
            f"{single:.1f} kB float); a step at worst: {self.multiplications} multiplications "
            f"with additions, {self.activations} activations, some {self.locals} numbers on the "
            "stack"
        )


# ---- Text ----


def signal_lines(data: ControllerArrays, output: str) -> list[str]:
    """Return a line for each entry of an observation and of the output: name, unit and values."""
    labels = dict(data.get("labels", ()))
    lines = [f"A step is {data['dt']:g} {data.get('time_unit', '')}".rstrip() + "."]
    limits = zip(data["obs_names"], data["obs_rest"], data["obs_min"], data["obs_max"], strict=True)
    for i, (name, rest, low, high) in enumerate(limits):
        within = f", good within {low:.6g} to {high:.6g}" if high - low < np.inf else ""
        lines.append(f"obs[{i}]  {labels.get(name, name)}, {rest:.6g} at rest{within}")
    ends = data["bounds"] * data["action_scale"] + data["action_shift"]
    for i, (name, low, high) in enumerate(zip(data["action_names"], *ends, strict=True)):
        lines.append(f"{output}[{i}]  {labels.get(name, name)}, {low:.6g} to {high:.6g}")
    return lines


def decimal(value: float, precision: str) -> str:
    """Return the shortest decimal number that is exact in the precision, with a point."""
    text = str(np.float32(value)) if precision == "float" else repr(float(value))
    head, exponent, tail = text.partition("e")
    return f"{head if '.' in head else f'{head}.0'}{exponent}{tail}"


def literal(value: float, precision: str) -> str:
    """Return a number as C has it, exact in its precision."""
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return f"{decimal(value, precision)}{'f' if precision == 'float' else ''}"


def table(kind: str, name: str, values: NDArray[Any], precision: str) -> str:
    """Return the declaration of a constant array in C, of a type, of any shape but an empty one."""
    sizes = "".join(f"[{each}]" for each in values.shape)

    def shown(entry: Any) -> str:
        return literal(entry, precision) if values.dtype.kind == "f" else str(int(entry))

    body = np.array2string(
        values, max_line_width=90, separator=", ", threshold=sys.maxsize, formatter={"all": shown}
    )
    body = body.translate(str.maketrans("[]", "{}"))
    return f"static const {kind} {name}{sizes} =\n{body};"


def ascii_text(lines: Iterable[str]) -> str:
    """Return lines as one text in ASCII."""
    plain = normalize("NFKC", "\n".join(lines).replace("°", "deg"))  # a square is m2
    return plain.encode("ascii", "backslashreplace").decode()


# ---- Points at which answers are known ----


def sample_observations(controller: Controller, count: int) -> Array:
    """Return observations (count, n_obs): the operating point, then some in and around the box.

    Every other one is nearer to the operating point, where the MPC of a wide box has a solution.
    """
    data = controller.data
    generator = np.random.default_rng(0)
    low, high = data["box"]
    theta = (low + high) / 2 + generator.uniform(-0.65, 0.65, (count, len(low))) * (high - low)
    theta[::2] *= 2.0 ** -(np.arange(len(theta[::2])) % 8)[:, None]
    theta[0] = 0.0
    return np.asarray((theta - data["obs_offset"]) @ np.linalg.pinv(data["obs_matrix"]).T)


def insensitive(controller: Controller, obs: Array, precision: str) -> Array:
    """Return the rows of obs whose answer a rounding of the observation does not change.

    A policy with a network for each region jumps from one to the next: readings are moved by many
    roundings, and the answer may change by as many times its room.
    """
    size, times = (1e-6, 10) if precision == "float" else (1e-13, 100)
    largest = np.maximum(np.abs(obs).max(0), np.finfo(float).tiny)
    # A small row's roundings are small: what is near to rest is kept beside a wide box.
    scale = largest * (np.abs(obs) / largest).max(axis=1, keepdims=True)
    actions = controller.evaluate(obs)
    kept = np.ones(len(obs), bool)
    half = input_ranges(controller, actions) / 2
    inside = controller.in_domain(obs)
    outside = room_of(controller.data, precision, inside=False)
    room = np.where(inside, room_of(controller.data, precision), outside)[:, None]
    is_online = "qp_gram" in controller.data  # and continuous: all readings move at once
    for sign in (-1, 1):
        for j in [slice(None)] if is_online else range(obs.shape[1]):
            moved = obs.copy()
            moved[:, j] += sign * 2 * size * scale[:, j]
            change = np.abs(controller.evaluate(moved) - actions) / half
            kept &= (change < times * room).all(1)
            kept &= controller.in_domain(moved) == inside
    return np.asarray(obs[kept])


def input_ranges(controller: Controller, actions: Array) -> Array:
    """Return the ranges of the inputs (m,), of those without bounds what the actions span."""
    scale = controller.data["action_scale"]
    bounds = controller.data["bounds"]
    largest = np.abs(actions - controller.data["action_shift"]).max(0)
    return 2 * np.where(np.isfinite(bounds).all(0), scale, np.maximum(scale, largest))
