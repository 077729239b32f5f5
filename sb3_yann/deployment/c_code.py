"""A controller as C99: one file, its header, and a test of its own with known answers."""

from __future__ import annotations

import zlib
from importlib.resources import files

from sb3_yann.deployment.c_text import comment, literal, table
from sb3_yann.deployment.controller import Controller
from sb3_yann.deployment.cost import cost_of
from sb3_yann.deployment.describe import Arrays, in_words
from sb3_yann.deployment.rounding import rounding_of
from sb3_yann.deployment.selftest import vectors
from sb3_yann.deployment.tables import index_bytes, search_tables, tables_of

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
    shown = [f"  {line}" for line in in_words(data, "action")]
    entries = {
        "ABOUT": comment([*about.splitlines(), "", *shown, "", f"{cost_of(data)}."]),
        "SIZES": _sizes(data),
        "REAL": precision,
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
    export = f"{zlib.crc32(''.join(found.values()).encode('ascii')):#010x}"
    return {
        name: text.replace("@FILE@", file).replace("@EXPORT@", export)
        for name, text in found.items()
    }


def _sizes(data: Arrays) -> str:
    n_obs, m = data["obs_matrix"].shape[1], len(data["action_scale"])
    return f"#define YANN_N_OBS {n_obs}\n#define YANN_N_INPUTS {m}"


def _tables(data: Arrays, precision: str) -> str:
    """Return sizes, options and tables."""
    p, _, n = data["gains"].shape
    walks, trees = data["neighbors"].size > 0, "tree_levels" in data
    n_networks = len(data["pinned"])
    rounding = rounding_of(data, precision)._asdict()
    flags: dict[str, object] = {
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
    numbers, whole = tables_of(data, precision)
    of_search, indices_of_search = search_tables(data)
    numbers, whole = {**numbers, **of_search}, {**whole, **indices_of_search}
    if walks:
        flags["WALK_FROM"] = int(data["walk_from"])
    if n_networks:
        flags |= _network_flags(data, precision)
    index = f"int{8 * index_bytes(whole)}_t"
    defined = [f"#define {name} {value}" for name, value in flags.items()]
    tables = [table("real", name, each, precision) for name, each in numbers.items()]
    indices = [table(index, name, each, precision) for name, each in whole.items()]
    return "\n".join([*defined, "", *tables, *indices])


def _network_flags(data: Arrays, precision: str) -> dict[str, object]:
    """Return the sizes of the networks."""
    last = int(data["n_layers"]) - 1
    widths = [data[f"layer{i}"].shape[1] for i in range(last)]
    full, none = data["fades"]
    return {
        "N_LAYERS": last + 1,
        **{f"WIDTH_{i + 1}": width for i, width in enumerate(widths)},
        "WIDTH_LAST": widths[-1],
        "ACTIVATION": ACTIVATION[str(data["activation"]), precision],
        "REACH": f"((real){literal(data['reach'], precision)})",
        "FADES_FROM": literal(full, precision),
        "FADES_TO": literal(none, precision),
    }
