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
from pathlib import Path
from xml.etree import ElementTree as ET

from sb3_yann.deployment.c_code import c_files, comment, fill
from sb3_yann.deployment.code import Arrays, literal

LIBRARIES = {
    ("Linux", "x86_64"): ("linux64", ".so"),
    ("Darwin", "x86_64"): ("darwin64", ".dylib"),
    ("Darwin", "arm64"): ("darwin64", ".dylib"),
}
COMPILERS = "cc", "gcc", "clang"
FLAGS = "-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"


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
        The comment at the top: where it comes from.
    """
    name = str(data["name"])
    identity = "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, f"{precision} {about}")) + "}"
    sources = {
        file: text
        for file, text in c_files(data, precision, about, name).items()
        if not file.endswith("_selftest.c")
    }
    rest = ", ".join(literal(each, "double") for each in data["obs_rest"])
    entries = {
        "ABOUT": comment(about.splitlines()),
        "FILE": name,
        "GUID": identity,
        "DT": literal(float(data["dt"]), "double"),
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
    library = _library(sources) if folder else b""
    if library:
        parts[f"binaries/{folder}/{name}{suffix}"] = library
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in parts.items():
            entry = zipfile.ZipInfo(path)  # with the same date each time: the same file
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
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
    warnings.warn(
        f"{compiler} failed, so the FMU holds sources and no library: {errors.strip()[:300]}",
        RuntimeWarning,
        stacklevel=2,
    )
    return b""


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
    inputs = [*map(str, data["action_names"])]
    who = "0 the policy, 1 the MPC, 2 manual"
    taken: list[tuple[str, str, str, str, str | None]] = []
    for i, (name, rest) in enumerate(zip(data["obs_names"], data["obs_rest"], strict=True)):
        start = repr(float(rest))
        taken.append(("Real", "input", f"obs[{i}]", str(name), start))
    elapsed = "time since the last step in units of dt; 0 where it is not known"
    taken.append(("Real", "input", "elapsed", elapsed, "0.0"))
    for i, name in enumerate(inputs):
        taken.append(("Real", "input", f"manual[{i}]", f"{name}, of the operator", "0.0"))
    for i, name in enumerate(inputs):
        taken.append(("Real", "output", f"command[{i}]", name, None))
    taken += [
        ("Integer", "input", "request", who, "0"),
        ("Integer", "output", "status", "0, or the sum of what was found", None),
        ("Integer", "output", "mode", f"who acted: {who}", None),
        ("Boolean", "input", "has_manual", "false holds the output while manual", "false"),
    ]
    counts = dict.fromkeys(("Real", "Integer", "Boolean"), 0)
    for kind, causality, name, description, start_value in taken:
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
        ET.SubElement(variable, kind, {} if start_value is None else {"start": start_value})
