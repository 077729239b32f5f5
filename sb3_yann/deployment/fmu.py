"""A controller as an FMU, FMI 2.0 for co-simulation: its C code, and a library where one can be."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import zipfile
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

from sb3_yann.deployment.c_code import c_files
from sb3_yann.deployment.describe import Arrays

COMPILERS = "cc", "gcc", "clang"


def fmu_bytes(data: Arrays, precision: str, about: str, digest: str) -> bytes:
    """Return the file of an FMU: description, sources, and a library for 64-bit Linux.

    The library is there only if it is written on such a machine with a C compiler; others compile
    the sources, as importers of FMUs with sources do.

    Parameters
    ----------
    data : dict of str to ndarray
        As `describe` returns them.
    precision : {"double", "float"}
        Of the computation; an FMU's own numbers are doubles.
    about : str
        What stands at the top of the sources.
    digest : str
        Of the arrays: it is the FMU's own identifier.
    """
    name = str(data["name"])
    texts = c_files(data, precision, about, name)
    texts.pop(f"{name}_selftest.c")
    guid = f"{{sb3-yann-{digest}}}"
    wrapper = (files("sb3_yann.deployment") / "c" / "fmi2.c").read_text(encoding="ascii")
    entries = {"FILE": name, "GUID": guid, "DT": repr(_step(data))}
    for key, entry in entries.items():
        wrapper = wrapper.replace(f"@{key}@", entry)
    wrapper = wrapper.replace("YANN_", f"{name.upper()}_").replace("yann_", f"{name}_")
    texts["fmi2.c"] = wrapper
    found = io.BytesIO()
    with zipfile.ZipFile(found, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("modelDescription.xml"), _description(data, guid, texts))
        for file, text in texts.items():
            archive.writestr(zipfile.ZipInfo(f"sources/{file}"), text)
        if library := _compiled(texts):
            archive.writestr(zipfile.ZipInfo(f"binaries/linux64/{name}.so"), library)
    return found.getvalue()


def _step(data: Arrays) -> float:
    """Return the sampling time, 1 where none is known."""
    return float(data["dt"]) or 1.0


def _compiled(texts: dict[str, str]) -> bytes | None:
    """Return the library, or None where none can be made."""
    compiler = next(filter(shutil.which, COMPILERS), None)
    if compiler is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return None
    with TemporaryDirectory() as folder:
        for file, text in texts.items():
            (Path(folder) / file).write_text(text, encoding="ascii")
        sources = sorted(file for file in texts if file.endswith(".c"))
        command = [compiler, "-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        built = [*command, *sources, "-lm", "-o", "fmu.so"]
        if subprocess.run(built, cwd=folder, capture_output=True).returncode:
            return None
        return (Path(folder) / "fmu.so").read_bytes()


def _description(data: Arrays, guid: str, texts: dict[str, str]) -> str:
    name, n_obs, m = str(data["name"]), len(data["obs_rest"]), len(data["action_scale"])
    variables = [
        _variable(f"obs[{i}]", i, "input", said, f'Real start="{float(data["obs_rest"][i])!r}"')
        for i, said in enumerate(data["obs_names"])
    ]
    for what, said, first in (
        ("manual", "the operator's output", n_obs),
        ("command", "", n_obs + m),
    ):
        for i, called in enumerate(data["action_names"]):
            kind = "input" if what == "manual" else "output"
            start = 'Real start="0.0"' if kind == "input" else "Real"
            text = f"{called}: {said}" if said else called
            variables.append(_variable(f"{what}[{i}]", first + i, kind, text, start))
    requested = "0 the policy, 1 the MPC, 2 manual"
    variables += [
        _variable("request", 0, "input", requested, 'Integer start="0" min="0" max="2"'),
        _variable("status", 1, "output", "what the step found, 0 for nothing", "Integer"),
        _variable("mode", 2, "output", f"who acted: {requested}", "Integer"),
        _variable("has_manual", 0, "input", "whether manual counts", 'Boolean start="false"'),
    ]
    outputs = [i for i, each in enumerate(variables, 1) if 'causality="output"' in each]
    unknowns = "".join(f'<Unknown index="{i}"/>' for i in outputs)
    sources = "".join(f'<File name="{file}"/>' for file in sorted(texts) if file.endswith(".c"))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{guid}" '
        'generationTool="sb3-yann" variableNamingConvention="structured">\n'
        f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true">'
        f"<SourceFiles>{sources}</SourceFiles></CoSimulation>\n"
        f'<DefaultExperiment stepSize="{_step(data)!r}"/>\n'
        f"<ModelVariables>\n{''.join(variables)}</ModelVariables>\n"
        f"<ModelStructure><Outputs>{unknowns}</Outputs>"
        f"<InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>\n"
        "</fmiModelDescription>\n"
    )


def _variable(name: str, reference: int, causality: str, said: str, kind: str) -> str:
    initial = ' initial="calculated"' if causality == "output" else ""
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="discrete"{initial} description={quoteattr(said)}><{kind}/>'
        "</ScalarVariable>\n"
    )
