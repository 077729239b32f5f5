"""A controller as C99: one file, its header, and a test of its own with known answers."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from importlib.resources import files

from sb3_yann.deployment import code
from sb3_yann.deployment.code import Arrays, literal, table
from sb3_yann.deployment.controller import steps_of
from sb3_yann.deployment.known_answers import known_answers


def c_files(data: Arrays, precision: str, about: str, file: str) -> dict[str, str]:
    """Return the texts of the C files by their names.

    Parameters
    ----------
    data : dict of str to ndarray
        As `describe` returns them.
    precision : {"double", "float"}
        Of all numbers.
    about : str
        The comment at the top: where it comes from.
    file : str
        What the files are called, without a suffix.
    """
    lines = [f"  {line}" for line in code.signal_lines(data, "action")]
    n_obs, n_seen = len(data["obs_rest"]), data["obs_matrix"].shape[1]
    sizes = {"N_OBS": n_obs, "N_SEEN": n_seen, "N_INPUTS": len(data["action_scale"])}
    memory = ""
    if estimates := len(data.get("est_gain", ())):
        memory = f"    yann_real estimate[{estimates}]; /* states and disturbances */\n"
        if loads := len(data["est_loads"]):
            memory += f"    yann_real load[{loads}]; /* measured disturbances */\n"
    entries = {
        "ABOUT": comment([*about.splitlines(), "", *lines, "", f"{code.Cost.of(data)}."]),
        "SIZES": "\n".join(f"#define YANN_{key} {size}" for key, size in sizes.items()),
        "MEMORY": memory,
        "REAL": precision,
        "TABLES": _definitions(data, precision),
        "ONLINE": _template("online.c") if "qp_gram" in data else "",
        "ESTIMATOR": _template("estimator.c") if estimates else "",
        **known_answers(data, precision),
    }
    suffixes = {"controller.c": ".c", "controller.h": ".h", "selftest.c": "_selftest.c"}
    texts = {file + suffix: fill(each, entries, data) for each, suffix in suffixes.items()}
    export = f"{zlib.crc32(''.join(texts.values()).encode('ascii')):#010x}"
    return {
        path: text.replace("@FILE@", file).replace("@EXPORT@", export)
        for path, text in texts.items()
    }


def fill(template: str, entries: Mapping[str, str], data: Arrays) -> str:
    """Return a template of C with its entries, ``@KEY@``, and with the controller's prefix."""
    text = _template(template)
    for key, entry in entries.items():
        text = text.replace(f"@{key}@", entry)
    name = str(data["name"])
    return text.replace("YANN_", f"{name.upper()}_").replace("yann_", f"{name}_")


def _template(name: str) -> str:
    return (files("sb3_yann.deployment") / "c" / name).read_text(encoding="ascii")


def comment(lines: list[str]) -> str:
    """Return lines of a comment in ASCII, which nothing in them can end."""
    safe = code.ascii_text(lines).replace("*/", "* /").replace("/*", "/ *")
    safe = safe.replace("??", "? ?").replace("??", "? ?")  # trigraphs
    return "\n".join(f" * {line}".rstrip().rstrip("\\") for line in safe.splitlines())


def _definitions(data: Arrays, precision: str) -> str:
    """Return sizes, options and tables."""
    numbers, indices = code.controller_tables(data, precision)
    search_numbers, search_indices = code.search_tables(data)
    numbers, indices = {**numbers, **search_numbers}, {**indices, **search_indices}
    walks, n_networks = data["neighbors"].size > 0, len(data["pinned"])
    suffix = "f" if precision == "float" else ""
    flags: dict[str, object] = {
        "N_THETA": data["gains"].shape[2],
        "N_REGIONS": len(data["gains"]),
        "FABS(x)": f"fabs{suffix}(x)",
        "SEARCH_BY_WALK": int(walks),
        "DISJOINT": int(data["disjoint"]),
        "ZERO_INPUT": int(data["zero_input"]),
        "RATE": int(len(data["change"]) > 0),
        "MOVING": int(len(data["moving"]) > 0),
        "N_NETWORKS": n_networks,
        "ONLINE": int("qp_gram" in data),
        "N_ESTIMATES": len(data.get("est_gain", ())),
    }
    if "est_gain" in data:
        flags |= {"N_OUTPUTS": len(data["est_C"]), "N_LOADS": len(data["est_loads"])}
    if "qp_gram" in data:
        rows, most = len(data["qp_d0"]), int(data["qp_most"])
        flags |= {"QP_ROWS": rows, "QP_MOST": most, "QP_FIXED": len(data["qp_fixed"])}
        flags |= {"QP_ROOM": most if data["zero_input"] else rows, "QP_STEPS": steps_of(data)}
    flags |= {
        key.upper(): int(data[key]) for key in ("frozen_after", "hold", "recover", "transfer")
    }
    tolerances = {"late_after": data["late_after"], **code.search_tolerances(data, precision)}
    flags |= {key.upper(): literal(value, precision) for key, value in tolerances.items()}
    if walks:
        flags["WALK_FROM"] = int(data["walk_from"])
    if n_networks:
        n_layers = int(data["n_layers"])
        widths = [data[f"layer{i}"].shape[1] for i in range(n_layers - 1)]
        activation = {
            "tanh": f"tanh{suffix}(x)",
            "relu": "x > ZERO ? x : ZERO",
            "elu": f"x > ZERO ? x : expm1{suffix}(x)",
        }[str(data["activation"])]
        fade_start, fade_end = data["fades"]
        flags |= {
            "N_LAYERS": n_layers,
            **{f"WIDTH_{i + 1}": width for i, width in enumerate(widths)},
            "WIDTH_LAST": widths[-1],
            "ACTIVATION": activation,
            "REACH": f"((real){literal(data['reach'], precision)})",
            "FADES_FROM": literal(fade_start, precision),
            "FADES_TO": literal(fade_end, precision),
            "N_KEPT": len(data["kept"]),
        }
    index = f"int{8 * code.index_bytes(indices)}_t"
    lines = [f"#define {key} {value}" for key, value in flags.items()]
    lines += ["", *(table("real", key, each, precision) for key, each in numbers.items())]
    lines += [table(index, key, each, precision) for key, each in indices.items()]
    return "\n".join(lines)
