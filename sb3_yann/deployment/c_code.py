"""A controller as C99 with a test of its own, and as an FMU for co-simulation (FMI 2.0)."""

from __future__ import annotations

import io
import os
import platform
import shutil
import signal
import subprocess
import tempfile
import uuid
import zipfile
import zlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, warn
from sb3_yann.deployment import code
from sb3_yann.deployment.code import ControllerArrays, Tables
from sb3_yann.deployment.controller import DRIVING, KEPT_ROUNDING, MODES, Controller, steps_of
from sb3_yann.log import SECONDS


def known_answers(data: ControllerArrays, precision: str) -> dict[str, str]:
    """Return what the self-test in C is filled with: points and steps, and what they must give."""
    controller = Controller(data)
    n_points = 48
    drawn = code.sample_observations(controller, 4 * n_points)
    if precision == "float":
        drawn = drawn.astype(np.float32).astype(np.float64)
    obs = code.insensitive(controller, drawn, precision)[:n_points]
    room = code.room_of(data, precision)
    # Beyond the box inputs may rest at their bounds, whatever is lost of a reading.
    steady = [np.any(controller.in_domain(each)) for each in (drawn, obs)]
    if not len(obs) or steady == [True, False]:
        cure = "Pass precision='double'." if precision == "float" else "Export npz, st or onnx."
        raise ValueError(
            f"In {precision} a rounding of a reading moves the output by more than {room:g} of its "
            f"range, at all points tried: readings are large beside what they move by. {cure}"
        )
    ranges = code.input_ranges(controller, controller.evaluate(drawn))
    run = _closed_loop(data, obs) if "est_gain" in data else _steps(obs)
    answers = _play(run, controller)
    room_in_loop = 0.0
    unsure = np.zeros(len(answers["status"]), int)  # bits of the status
    for seed in range(5 if "C_of_plant" in run else 0):
        # What roundings of the outputs do to the loop, code may do too.
        moved = _play(run, controller, 1e-6 if precision == "float" else 1e-13, seed)
        change = np.abs(moved["actions"] - answers["actions"]) / ranges
        room_in_loop = max(room_in_loop, 10 * float(change.max()))
        unsure |= moved["status"] ^ answers["status"]
    if precision == "float" and room_in_loop > 1:
        raise ValueError(
            f"In float roundings of readings move the inputs of the estimator's loop by "
            f"{room_in_loop / 10:.0e} of their range: readings are large beside what they move by. "
            "Pass precision='double'."
        )
    numbers: Tables = {
        "points": obs,
        "policy": controller.evaluate(obs),
        "law": controller.evaluate(obs, networks=False),
        "range_of": ranges,
        **{key: each for key, each in run.items() if each.size},
        **answers,
        "unsure": unsure,
    }
    texts = [
        code.table("yann_real" if each.dtype.kind == "f" else "int", name, each, precision)
        for name, each in numbers.items()
    ]
    n_outputs, n_states = run["C_of_plant"].shape if "C_of_plant" in run else (0, 0)
    return {
        "VECTORS": "\n".join(texts),
        "POINTS": str(len(obs)),
        "STEPS": str(len(run["lost"])),
        "STATES": str(n_states),
        "OUTPUTS": str(n_outputs),
        "LOADS": str(len(run.get("loads_of_plant", ()))),
        "ROOM_INSIDE": f"{room:g}",
        "ROOM_OUTSIDE": f"{code.room_of(data, precision, inside=False):g}",
        "ROOM_IN_LOOP": f"{room_in_loop:.2g}",
    }


def _steps(readings: Array, count: int = 60, **plant: NDArray[Any]) -> Tables:
    """Return so many steps, each reading for four of them, with lost ones, a late one, all modes.

    A second start takes the plant's input then. Where there is a plant, its outputs are added to
    the first readings.
    """
    k = np.arange(count)
    return {
        "readings": readings[k // 4 % len(readings)],
        "elapsed": np.where(k == 20, 3.0, 1.0),
        **plant,
        "lost": ((k >= 10) & (k < 13)) | ((k >= 30) & (k < 40)),  # the first reading is
        "starts_anew": k == count - 15,
        "requests": np.select([(k >= 50) & (k < 53), (k >= 56) & (k < 60)], [1, 2], 0),
    }


def _closed_loop(data: ControllerArrays, seen: Array) -> Tables:
    """Return steps of a closed loop with the estimator's own model as the plant.

    It begins beside the operating point, with a load that the estimator must find; references
    and measured loads change. The plant is x+ = step_of_plant [x; u; loads; 1].
    """
    (size, q) = data["est_gain"].shape
    rest = data["obs_rest"]
    half = (data["box"][1] - data["box"][0]) / 2
    x = data["est_first"] @ np.append(rest[:q], 1.0)
    spread = np.zeros(size)
    readings = np.tile(rest, (50, 1))
    for column, place in enumerate(data["source"]):
        if len(rest) <= place < len(rest) + size:
            spread[place - len(rest)] = half[column]
        elif place < len(rest):
            steps = seen[np.arange(50) // 5 % len(seen), column]
            readings[:, place] += 0.1 * (steps - rest[place])
    noise = np.random.default_rng(0).normal(size=(50, q))
    readings[:, :q] = 1e-3 * noise * (np.abs(data["est_C"]) @ spread)
    scale, shift = data["est_input"]
    step = data["est_next"].copy()
    step[:, -1] += step[:, size : size + len(scale)] @ shift
    step[:, size : size + len(scale)] *= scale
    return _steps(
        readings,
        200,
        step_of_plant=step,
        C_of_plant=data["est_C"],
        start_of_plant=x + 0.2 * spread,
        loads_of_plant=data["est_loads"],
    )


def _play(run: Tables, controller: Controller, moved: float = 0.0, seed: int = 0) -> Tables:
    """Return actions (T, m), status and modes; outputs move by a part of their size."""
    controller.reset()
    generator = np.random.default_rng([2, seed])
    x = run.get("start_of_plant")
    actions: list[Array] = []
    status = []
    modes = []
    for k, reading in enumerate(run["readings"]):
        given = reading.copy()
        if x is not None:
            y = run["C_of_plant"] @ x
            given[: len(y)] += y * (1 + moved * generator.choice([-1, 1], len(y)))
        if run["lost"][k]:
            given[0] = np.nan
        if run["starts_anew"][k]:
            controller.reset()
        controller.request = MODES[run["requests"][k]]
        present = actions[-1] if run["starts_anew"][k] else None
        actions.append(controller(given, run["elapsed"][k], present))
        status.append(int(controller.status))
        modes.append(MODES.index(controller.mode))
        if x is not None:
            loads = reading[run["loads_of_plant"]]
            x = run["step_of_plant"] @ [*x, *actions[-1], *loads, 1.0]
    return {"actions": np.array(actions), "status": np.array(status), "modes": np.array(modes)}


def c_files(data: ControllerArrays, precision: str, about: str, file: str) -> dict[str, str]:
    """Return the texts of the C files by their names."""
    lines = [f"  {line}" for line in code.signal_lines(data, "action")]
    sizes = {"N_OBS": len(data["obs_rest"]), "N_SEEN": data["obs_matrix"].shape[1]}
    sizes["N_INPUTS"] = len(data["action_scale"])
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


def fill(template: str, entries: Mapping[str, str], data: ControllerArrays) -> str:
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


def _definitions(data: ControllerArrays, precision: str) -> str:
    """Return sizes, options and tables."""
    numbers, indices = code.controller_tables(data, precision)
    walks = data["neighbors"].size > 0
    n_networks = len(data["pinned"])
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
        rows = len(data["qp_d0"])
        most = int(data["qp_most"])
        flags |= {"QP_ROWS": rows, "QP_MOST": most, "QP_FIXED": len(data["qp_fixed"])}
        flags |= {"QP_ROOM": most if data["zero_input"] else rows, "QP_STEPS": steps_of(data)}
    flags |= {
        key.upper(): int(data[key]) for key in ("frozen_after", "hold", "recover", "transfer")
    }
    reals = {"late_after": data["late_after"], "driving": DRIVING}
    reals |= code.search_tolerances(data, precision)
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
        reals["fades_from"], reals["fades_to"] = data["fades"]
        reals["kept_rounding"] = KEPT_ROUNDING
        flags |= {
            "N_LAYERS": n_layers,
            **{f"WIDTH_{i + 1}": width for i, width in enumerate(widths)},
            "WIDTH_LAST": widths[-1],
            "ACTIVATION": activation,
            "REACH": f"((real){code.literal(data['reach'], precision)})",
            "N_KEPT": len(data["kept"]),
        }
    flags |= {key.upper(): code.literal(value, precision) for key, value in reals.items()}
    index = f"int{8 * code.index_bytes(indices)}_t"
    lines = [f"#define {key} {value}" for key, value in flags.items()]
    lines += ["", *(code.table("real", key, each, precision) for key, each in numbers.items())]
    lines += [code.table(index, key, each, precision) for key, each in indices.items()]
    return "\n".join(lines)


LIBRARIES = {
    ("Linux", "x86_64"): ("linux64", ".so"),
    ("Darwin", "x86_64"): ("darwin64", ".dylib"),
    ("Darwin", "arm64"): ("darwin64", ".dylib"),
}
COMPILERS = "cc", "gcc", "clang"
FLAGS = "-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"


def fmu_file(data: ControllerArrays, precision: str, about: str) -> bytes:
    """Return the bytes of an FMU.

    It holds the C code, and a library for this machine where a C compiler is at hand. A step is a
    step of the controller: the communication step is its dt, in seconds as FMI has it (2.0, Section
    2.2.7), or in the model's unit where that is none of time.
    """
    name = str(data["name"])
    identity = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, f"{precision} {about}")) + "}"
    sources = c_files(data, precision, about, name)
    del sources[f"{name}_selftest.c"]
    rest = ", ".join(code.literal(each, "double") for each in data["obs_rest"])
    entries = {
        "ABOUT": comment(about.splitlines()),
        "FILE": name,
        "GUID": identity,
        "DT": code.literal(_seconds(data), "double"),
        "REST": f"{{{rest}}}",
    }
    for suffix in (".c", ".h"):
        sources[f"{name}_fmi2{suffix}"] = fill(f"fmi2{suffix}", entries, data)
    units = [file for file in sources if file.endswith(".c")]
    parts: dict[str, bytes] = {
        "modelDescription.xml": _description(data, about, identity, units),
        **{f"sources/{file}": text.encode("ascii") for file, text in sources.items()},
    }
    folder, suffix = LIBRARIES.get((platform.system(), platform.machine()), ("", ""))
    if folder and (library := _library(sources)):
        parts[f"binaries/{folder}/{name}{suffix}"] = library
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in parts.items():
            entry = zipfile.ZipInfo(path)  # with the same date each time: the same file
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return file.getvalue()


def _library(sources: dict[str, str]) -> bytes:
    """Return a shared library of the sources; nothing where there is no compiler."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        return b""
    with tempfile.TemporaryDirectory() as folder:
        for file, text in sources.items():
            (Path(folder) / file).write_text(text, encoding="ascii")
        units = [file for file in sources if file.endswith(".c")]
        command = [compiler, *FLAGS, *units, "-lm", "-o", "library"]
        # Its temporary files lie in the folder. An interrupt ends all processes of the compiler
        # before the folder is removed.
        process = subprocess.Popen(
            command,
            cwd=folder,
            env={**os.environ, "TMPDIR": folder},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            errors = process.communicate()[1]
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
        if process.returncode == 0:
            return (Path(folder) / "library").read_bytes()
    warn(
        f"{compiler} failed, so the FMU holds sources and no library: {errors.strip()[:300]}",
        RuntimeWarning,
    )
    return b""


def _seconds(data: ControllerArrays) -> float:
    return float(data["dt"]) * SECONDS.get(str(data.get("time_unit", "")), 1)


def _description(data: ControllerArrays, about: str, identity: str, units: list[str]) -> bytes:
    name = str(data["name"])
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=name,
        guid=identity,
        description=about,
        generationTool="sb3-yann",
        variableNamingConvention="structured",
    )
    kind = ET.SubElement(root, "CoSimulation", modelIdentifier=name)
    listed = ET.SubElement(kind, "SourceFiles")
    for unit in units:
        ET.SubElement(listed, "File", name=unit)
    variables = ET.Element("ModelVariables")
    _add_variables(variables, data)
    if named := sorted({each[0].get("unit", "") for each in variables} - {""}):
        defined = ET.SubElement(root, "UnitDefinitions")
        for unit in named:
            ET.SubElement(defined, "Unit", name=unit)
    ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name="logStatusError")
    if data["dt"]:
        ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(_seconds(data)))
    root.append(variables)
    structure = ET.SubElement(root, "ModelStructure")
    found = [i + 1 for i, each in enumerate(variables) if each.get("causality") == "output"]
    for part in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(structure, part)
        for index in found:
            ET.SubElement(unknowns, "Unknown", index=str(index))
    ET.indent(root)
    return bytes(ET.tostring(root, "utf-8", xml_declaration=True)) + b"\n"


def _add_variables(within: ET.Element, data: ControllerArrays) -> None:
    """Add all variables, in the order of their value references."""
    labels = dict(data.get("labels", ()))
    inputs = [*enumerate(map(str, data["action_names"]))]
    readings = enumerate(zip(data["obs_names"], data["obs_rest"], strict=True))
    ends = data["bounds"] * data["action_scale"] + data["action_shift"]
    limits = zip(data["obs_names"], data["obs_min"], data["obs_max"], strict=True)
    spans = {f"obs[{i}]": each for i, each in enumerate(limits)}
    spans |= {f"command[{i}]": (name, *ends[:, i]) for i, name in inputs}
    spans |= {f"manual[{i}]": (name, -np.inf, np.inf) for i, name in inputs}
    who = "0 the policy, 1 the MPC, 2 manual"
    elapsed = "time since the last step in units of dt; 0 where it is not known"
    taken: list[tuple[str, str, str, str, str | None]] = [
        *(("Real", "input", f"obs[{i}]", str(k), repr(float(rest))) for i, (k, rest) in readings),
        ("Real", "input", "elapsed", elapsed, "0.0"),
        *(("Real", "input", f"manual[{i}]", f"{k}, of the operator", "0.0") for i, k in inputs),
        *(("Real", "output", f"command[{i}]", name, None) for i, name in inputs),
        ("Integer", "input", "request", who, "0"),
        ("Integer", "output", "status", "0, or the sum of what was found", None),
        ("Integer", "output", "mode", f"who acted: {who}", None),
        ("Boolean", "input", "has_manual", "false holds the output while manual", "false"),
    ]
    counts = dict.fromkeys(("Real", "Integer", "Boolean"), 0)
    for kind, causality, name, description, start_value in taken:
        of, low, high = spans.get(name, ("", -np.inf, np.inf))
        pairs = zip(of.split(", "), labels.get(of, of).split(", "), strict=False)
        named = (label for own, label in pairs if label.startswith(f"{own} ("))
        unit = next((label.rpartition(" (")[2][:-1] for label in named), None)
        attributes = {"unit": unit, "start": start_value}
        attributes |= {"min": repr(float(low)) if np.isfinite(low) else None}
        attributes |= {"max": repr(float(high)) if np.isfinite(high) else None}
        variable = ET.SubElement(
            within,
            "ScalarVariable",
            name=name,
            valueReference=str(counts[kind]),
            description=description,
            causality=causality,
            variability="discrete",
        )
        counts[kind] += 1
        ET.SubElement(variable, kind, {key: each for key, each in attributes.items() if each})
