"""A controller as C99: one file, its header, and a test of its own with known answers."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from sb3_yann.deployment.c_text import comment, literal, table
from sb3_yann.deployment.controller import Controller
from sb3_yann.deployment.cost import cost_of, index_bytes
from sb3_yann.deployment.describe import Arrays
from sb3_yann.deployment.rounding import rounding_of
from sb3_yann.deployment.selftest import vectors

ACTIVATION = {
    ("tanh", "double"): "tanh(x)",
    ("tanh", "float"): "tanhf(x)",
    ("relu", "double"): "x > ZERO ? x : ZERO",
    ("relu", "float"): "x > ZERO ? x : ZERO",
    ("elu", "double"): "x > ZERO ? x : expm1(x)",
    ("elu", "float"): "x > ZERO ? x : expm1f(x)",
}


def c_files(data: Arrays, precision: str, about: str, file: str) -> dict[str, str]:
    """Return the texts of the C files by their names.

    Parameters
    ----------
    data : dict of str to ndarray
        As `describe` returns them.
    precision : {"double", "float"}
        Of all numbers.
    about : str
        What stands at the top: where it comes from.
    file : str
        What the files are called, without a suffix.
    """
    name = str(data["name"])
    entries = {
        "ABOUT": comment([*about.splitlines(), *_units(data), "", str(cost_of(data)) + "."]),
        "SIZES": _sizes(data),
        "REAL": precision,
        "FILE": file,
        "TABLES": _tables(data, precision),
    }
    suffixes = {"controller.c": ".c", "controller.h": ".h", "selftest.c": "_selftest.c"}
    found = {}
    for source, suffix in suffixes.items():
        text = (files("sb3_yann.deployment") / "c" / source).read_text(encoding="ascii")
        own = vectors(Controller(data), precision) if source == "selftest.c" else {}
        for key, entry in {**entries, **own}.items():
            text = text.replace(f"@{key}@", entry)
        text = text.replace("YANN_", f"{name.upper()}_").replace("yann_", f"{name}_")
        found[file + suffix] = text
    return found


def _units(data: Arrays) -> list[str]:
    def listed(kind: str, names: NDArray[np.str_]) -> list[str]:
        return [f"  {kind}[{i}]  {name}" for i, name in enumerate(names)]

    return ["", *listed("obs", data["obs_names"]), *listed("action", data["action_names"])]


def _sizes(data: Arrays) -> str:
    n_obs, m = data["obs_matrix"].shape[1], len(data["action_scale"])
    return f"#define YANN_N_OBS {n_obs}\n#define YANN_N_INPUTS {m}"


def _tables(data: Arrays, precision: str) -> str:
    """Return sizes, options and tables."""
    p, _, n = data["gains"].shape
    walks, trees = data["neighbors"].size > 0, "tree_levels" in data
    n_networks = len(data["pinned"])
    rounding = rounding_of(data, precision)._asdict()
    flags = {
        "N_THETA": n,
        "N_REGIONS": p,
        "FABS(x)": "fabsf(x)" if precision == "float" else "fabs(x)",
        "SEARCH_BY_WALK": int(walks),
        "SEARCH_BY_TREE": int(trees),
        "DISJOINT": int(data["disjoint"]),
        "ZERO_INPUT": int(data["zero_input"]),
        "RATE": int(len(data["change"]) > 0),
        "N_NETWORKS": n_networks,
        "FROZEN_AFTER": int(data["frozen_after"]),
        "HOLD": int(data["hold"]),
        "RECOVER": int(data["recover"]),
        "TRANSFER": int(data["transfer"]),
        "LATE_AFTER": literal(data["late_after"], precision),
        **{name.upper(): literal(value, precision) for name, value in rounding.items()},
    }
    numbers = {
        "A": data["A"], "b": data["b"], "gains": data["gains"], "offsets": data["offsets"],
        "input_min": data["bounds"][0], "input_max": data["bounds"][1],
        "obs_matrix": data["obs_matrix"], "obs_offset": data["obs_offset"],
        "obs_rest": data["obs_rest"], "obs_min": data["obs_min"], "obs_max": data["obs_max"],
        "action_scale": data["action_scale"], "action_shift": data["action_shift"],
        "resting": data["resting"],
    }  # fmt: skip
    whole = {
        "starts": np.array([*data["starts"], len(data["b"])]),
        "watched": data["watched"],
    }
    if walks:
        flags["WALK_FROM"] = int(data["walk_from"])
        whole["neighbors"], numbers["walk_slack"] = data["neighbors"], data["walk_slack"]
    if trees:
        numbers |= {f"tree_{key}": data[f"tree_{key}"] for key in ("normals", "levels")}
        keys = "children", "leaf_starts", "leaf_regions"
        whole |= {f"tree_{key}": data[f"tree_{key}"] for key in keys}
    if flags["RATE"]:
        numbers["change_min"], numbers["change_max"] = data["change"]
        numbers |= {"per_input": data["per_input"], "middle": data["middle"]}
    if n_networks:
        _add_networks(data, precision, flags, numbers, whole)
    index = f"int{8 * index_bytes(sum(map(np.size, whole.values())))}_t"
    defined = [f"#define {name} {value}" for name, value in flags.items()]
    tables = [table("real", name, each, precision) for name, each in numbers.items()]
    indices = [table(index, name, each, precision) for name, each in whole.items()]
    return "\n".join([*defined, "", *tables, *indices])


def _add_networks(
    data: Arrays,
    precision: str,
    flags: dict[str, object],
    numbers: dict[str, NDArray[np.float64]],
    whole: dict[str, NDArray[np.int64]],
) -> None:
    """Add the sizes and tables of the networks."""
    last = int(data["n_layers"]) - 1
    widths = [data[f"layer{i}"].shape[1] for i in range(last)]
    full, none = data["fades"]
    flags |= {
        "N_LAYERS": last + 1,
        **{f"WIDTH_{i + 1}": width for i, width in enumerate(widths)},
        "WIDTH_LAST": widths[-1],
        "ACTIVATION": ACTIVATION[str(data["activation"]), precision],
        "REACH": f"((real){literal(data['reach'], precision)})",
        "FADES_FROM": literal(full, precision),
        "FADES_TO": literal(none, precision),
    }
    numbers |= {f"layer{i}": data[f"layer{i}"] for i in range(last)}
    numbers |= {
        "last_layer": data[f"layer{last}"],
        "per_theta": data["per_theta"],
        "confine_middle": data["confines"][0],
        "confine_per_half": data["confines"][1],
    }
    whole |= {"network_of": data["network_of"], "pinned": data["pinned"].astype(np.int64)}
