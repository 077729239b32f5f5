"""A controller as an FMU for co-simulation (FMI 2.0): the C code, its interface, a library."""

from __future__ import annotations

import io
import os
import platform
import shutil
import signal
import subprocess
import tempfile
import uuid
import warnings
import zipfile
from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from sb3_yann.deployment.c_code import c_files
from sb3_yann.deployment.c_text import comment, literal
from sb3_yann.deployment.describe import Arrays

LIBRARIES = {
    ("Linux", "x86_64"): ("linux64", ".so"),
    ("Darwin", "x86_64"): ("darwin64", ".dylib"),
    ("Darwin", "arm64"): ("darwin64", ".dylib"),
}
COMPILERS = "cc", "gcc", "clang"
FLAGS = "-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"
WRITTEN = 1980, 1, 1, 0, 0, 0  # of every part, so that the same export is the same file


def fmu_file(data: Arrays, precision: str, about: str) -> bytes:
    """Return the bytes of an FMU.

    It holds the C code, and a library for this machine where a C compiler is at hand. A step is a
    step of the controller: the communication step is its dt.

    Parameters
    ----------
    data : dict of str to ndarray
        As `describe` returns them.
    precision : {"double", "float"}
        Of the calculation; the variables are in double.
    about : str
        Where it comes from.
    """
    name = str(data["name"])
    identity = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, f"{precision} {about}")) + "}"
    sources = {
        file: text
        for file, text in c_files(data, precision, about, name).items()
        if not file.endswith("_selftest.c")
    }
    sources |= _interface(data, about, identity)
    units = [file for file in sources if file.endswith(".c")]
    parts: dict[str, bytes] = {
        "modelDescription.xml": _description(data, about, identity, units),
        **{f"sources/{file}": text.encode("ascii") for file, text in sources.items()},
    }
    folder, suffix = LIBRARIES.get((platform.system(), platform.machine()), ("", ""))
    library = _library(sources) if folder else b""
    if library:
        parts[f"binaries/{folder}/{name}{suffix}"] = library
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in parts.items():
            entry = zipfile.ZipInfo(path, WRITTEN)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return file.getvalue()


def _interface(data: Arrays, about: str, identity: str) -> dict[str, str]:
    """Return the texts of the functions of FMI 2.0, and of their types."""
    name = str(data["name"])
    entries = {
        "ABOUT": comment(about.splitlines()),
        "FILE": name,
        "GUID": identity,
        "DT": literal(float(data["dt"]), "double"),
        "REST": "{" + ", ".join(literal(each, "double") for each in data["obs_rest"]) + "}",
    }
    found = {}
    for suffix in (".c", ".h"):
        text = (files("sb3_yann.deployment") / "c" / f"fmi2{suffix}").read_text(encoding="ascii")
        for key, entry in entries.items():
            text = text.replace(f"@{key}@", entry)
        text = text.replace("YANN_", f"{name.upper()}_").replace("yann_", f"{name}_")
        found[f"{name}_fmi2{suffix}"] = text
    return found


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
        code, said = _run(command, folder)
        if code:
            warnings.warn(
                f"{compiler} failed, so the FMU holds sources and no library: {said.strip()[:300]}",
                RuntimeWarning,
                stacklevel=2,
            )
            return b""
        return (Path(folder) / "library").read_bytes()


def _run(command: list[str], folder: str) -> tuple[int, str]:
    """Run a compiler; return its exit code and what it complains of.

    Its temporary files lie in the folder. Where Ctrl-C or an error cuts it off, all of its
    processes end before the folder is removed.
    """
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
        said = process.communicate()[1]
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
    return process.returncode, said


def _description(data: Arrays, about: str, identity: str, units: list[str]) -> bytes:
    """Return modelDescription.xml."""
    name, dt = str(data["name"]), float(data["dt"])
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
    logs = ET.SubElement(root, "LogCategories")
    ET.SubElement(logs, "Category", name="logStatusError")
    if dt:
        ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(dt))
    variables = ET.SubElement(root, "ModelVariables")
    _add_variables(variables, data)
    structure = ET.SubElement(root, "ModelStructure")
    found = [i + 1 for i, each in enumerate(variables) if each.get("causality") == "output"]
    for part in ("Outputs", "InitialUnknowns"):
        unknowns = ET.SubElement(structure, part)
        for index in found:
            ET.SubElement(unknowns, "Unknown", index=str(index))
    ET.indent(root)
    return bytes(ET.tostring(root, "utf-8", xml_declaration=True)) + b"\n"


def _add_variables(within: ET.Element, data: Arrays) -> None:
    """Add all variables, in the order of their value references."""
    n_obs, inputs = len(data["obs_rest"]), [*map(str, data["action_names"])]
    rest = [*map(float, data["obs_rest"])]
    shown = "time since the last step in units of dt; 0 where it is not known"
    who = "0 the policy, 1 the MPC, 2 manual"
    reals = [(f"obs[{i}]", str(data["obs_names"][i]), rest[i]) for i in range(n_obs)]
    reals += [("elapsed", shown, 0.0)]
    reals += [(f"manual[{i}]", f"{each}, of the operator", 0.0) for i, each in enumerate(inputs)]
    taken: list[tuple[str, str, list[tuple[str, str, float | None]]]] = [
        ("Real", "input", [*reals]),
        ("Real", "output", [(f"command[{i}]", each, None) for i, each in enumerate(inputs)]),
        ("Integer", "input", [("request", who, 0.0)]),
        ("Integer", "output", [("status", "0, or the sum of what was found", None)]),
        ("Integer", "output", [("mode", f"who acted: {who}", None)]),
        ("Boolean", "input", [("has_manual", "false holds the output while manual", 0.0)]),
    ]
    counts = dict.fromkeys(("Real", "Integer", "Boolean"), 0)
    for kind, causality, entries in taken:
        for name, description, start in entries:
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
            first = {} if start is None else {"start": _start(kind, start)}
            ET.SubElement(variable, kind, first)


def _start(kind: str, value: float) -> str:
    if kind == "Boolean":
        return "true" if value else "false"
    return str(int(value)) if kind == "Integer" else repr(float(np.float64(value)))
