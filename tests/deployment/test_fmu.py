"""An FMU of an export is the controller, step by step."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

from deployed import COMPILERS, STRICT, needs_compiler, observations, policy_of
from sb3_yann import Controller, export
from sb3_yann.deployment.controller import MODES


def unpacked(name, folder, **options):
    """Return the controller, and the FMU's description beside its files."""
    export(policy_of(name), folder / "plant.npz", **options)
    export(policy_of(name), folder / "plant.fmu", **options)
    with zipfile.ZipFile(folder / "plant.fmu") as archive:
        archive.extractall(folder / "fmu")
    root = ElementTree.parse(folder / "fmu" / "modelDescription.xml").getroot()
    return Controller.load(folder / "plant.npz"), root


class Instance:
    """An instance by its C interface, as an importer calls it."""

    def __init__(self, library, root) -> None:
        self.code = ctypes.CDLL(str(library))
        self.code.fmi2Instantiate.restype = ctypes.c_void_p
        self.references = {
            each.get("name"): int(each.get("valueReference"))
            for each in root.iter("ScalarVariable")
        }
        texts = [text.encode() if text else None for text in ("one", root.get("guid"), "")]
        own = self.code.fmi2Instantiate(texts[0], 1, texts[1], texts[2], None, 0, 0)
        self.own = ctypes.c_void_p(own)

    def call(self, kind, name, value=None):
        """Set a variable, or return what it is."""
        number = {"Real": ctypes.c_double, "Integer": ctypes.c_int, "Boolean": ctypes.c_int}[kind]
        held = number(0 if value is None else value)
        reference = ctypes.c_uint(self.references[name])
        way = "Get" if value is None else "Set"
        call = getattr(self.code, f"fmi2{way}{kind}")
        one = ctypes.c_size_t(1)
        assert call(self.own, ctypes.byref(reference), one, ctypes.byref(held)) == 0
        return held.value

    def step(self, size: float) -> None:
        time = ctypes.c_double(0.0)
        assert self.code.fmi2DoStep(self.own, time, ctypes.c_double(size), 1) == 0


@needs_compiler
@pytest.mark.parametrize("name", ["reactor", "two tanks, by a walk", "references and rates"])
def test_its_library_is_the_controller(name, tmp_path):
    controller, root = unpacked(name, tmp_path)
    one = Instance(tmp_path / "fmu/binaries/linux64/plant.so", root)
    m = len(controller.data["action_scale"])
    dt = float(root.find("DefaultExperiment").get("stepSize"))
    generator = np.random.default_rng(0)
    seen = set()
    for k, row in enumerate(observations(policy_of(name), 200)):
        if k % 30 > 26:
            row[0] = np.nan
        request = int(generator.choice([0, 1, 2], p=[0.8, 0.1, 0.1]))
        late = 2.0 if k % 50 == 49 else 1.0
        manual = generator.uniform(-1, 1, m)
        controller.request = MODES[request]
        wanted = controller(row, late, manual)
        for i, value in enumerate(row):
            one.call("Real", f"obs[{i}]", value)
        for i, value in enumerate(manual):
            one.call("Real", f"manual[{i}]", value)
        one.call("Integer", "request", request)
        one.call("Boolean", "has_manual", 1)
        one.step(late * dt)
        found = [one.call("Real", f"command[{i}]") for i in range(m)]
        scale = 2 * controller.data["action_scale"]
        assert np.max(np.abs(found - wanted) / scale) < 1e-12
        assert one.call("Integer", "status") == int(controller.status)
        assert MODES[one.call("Integer", "mode")] == controller.mode
        seen.add(controller.mode)
    assert seen == set(MODES)


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("precision", ["double", "float"])
def test_its_sources_compile_at_the_strictest(precision, compiler, tmp_path):
    _, root = unpacked("reactor", tmp_path, **{"precision": precision})
    named = [each.get("name") for each in root.iter("File")]
    assert sorted(named) == ["fmi2.c", "plant.c"]
    built = [compiler, *STRICT, "-shared", "-fPIC", *named, "-lm", "-o", "own.so"]
    subprocess.run(built, cwd=tmp_path / "fmu/sources", check=True)


def test_a_wrong_identifier_is_no_instance(tmp_path):
    if not COMPILERS:
        pytest.skip("no C compiler")
    _, root = unpacked("reactor", tmp_path)
    root.set("guid", "another")
    assert not Instance(tmp_path / "fmu/binaries/linux64/plant.so", root).own


def test_without_a_compiler_it_holds_the_sources_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    export(policy_of("reactor"), tmp_path / "plant.fmu")
    with zipfile.ZipFile(tmp_path / "plant.fmu") as archive:
        names = archive.namelist()
    wanted = {"modelDescription.xml", "sources/plant.c", "sources/plant.h", "sources/fmi2.c"}
    assert set(names) == wanted


@needs_compiler
def test_fmpy_validates_and_simulates_it(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    from fmpy.validation import validate_fmu

    controller, _ = unpacked("reactor", tmp_path)
    assert validate_fmu(str(tmp_path / "plant.fmu")) == []
    obs = observations(policy_of("reactor"), 20)
    dt = controller.data["dt"]
    names = [f"obs[{i}]" for i in range(4)]
    signal = np.array(
        [(k * dt, *row) for k, row in enumerate(obs)],
        dtype=[("time", float), *((name, float) for name in names)],
    )
    result = fmpy.simulate_fmu(
        str(tmp_path / "plant.fmu"), stop_time=19 * dt, output_interval=dt, input=signal,
        output=["command[0]", "status"],
    )  # fmt: skip
    assert len(result) >= 19 and np.all(np.isfinite(result["command[0]"]))
