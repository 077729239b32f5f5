"""The FMU of an export is the controller, step by step, as an importer calls it."""

import os
import platform
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from test_whole_controller import CHECKS, WITH_EXTRA, InPython, loop, noisy_steps, policy, problem

from deployed import COMPILERS, STRICT, error, needs_compiler, observations, policy_of, with_faults
from sb3_yann import Checks, Controller, LinearModel, LinearMPC, Tracking, export
from sb3_yann.deployment import c_code
from sb3_yann.deployment.code import ROOM
from sb3_yann.deployment.controller import MODES, Status

fmpy = pytest.importorskip("fmpy")
fmi2 = pytest.importorskip("fmpy.fmi2")
validate_fmu = pytest.importorskip("fmpy.validation").validate_fmu

OWN = c_code.LIBRARIES.get((platform.system(), platform.machine()))
needs_library = pytest.mark.skipif(OWN is None or not COMPILERS, reason="no library is made here")


class Instance:
    def __init__(self, folder: Path, guid: str = "") -> None:
        said = fmpy.read_model_description(str(folder))
        self.at = {each.name: each for each in said.modelVariables}
        self.dt = float(said.defaultExperiment.stepSize)
        self.fmu = fmi2.FMU2Slave(
            guid=guid or said.guid,
            unzipDirectory=str(folder),
            modelIdentifier=said.coSimulation.modelIdentifier,
            instanceName="one",
        )
        self.fmu.instantiate()

    def get(self, name: str):
        at = self.at[name]
        return getattr(self.fmu, f"get{at.type}")([at.valueReference])[0]

    def set(self, name: str, value) -> None:
        at = self.at[name]
        getattr(self.fmu, f"set{at.type}")([at.valueReference], [value])

    def give(self, obs, elapsed=1.0, request=0, manual=None) -> None:
        given = {f"obs[{i}]": value for i, value in enumerate(obs)}
        given |= {f"manual[{i}]": value for i, value in enumerate(() if manual is None else manual)}
        given |= {"elapsed": elapsed, "request": request, "has_manual": manual is not None}
        for name, value in given.items():
            self.set(name, value)

    def step(self, parts: float = 1.0) -> None:
        self.fmu.doStep(0.0, parts * self.dt)

    def outputs(self):
        command = [self.get(name) for name in self.at if name.startswith("command[")]
        return np.array(command), self.get("status"), MODES[self.get("mode")]


@pytest.fixture
def opened(tmp_path):
    """Return a function from a policy to an instance, and its controller."""
    found = []

    def open_one(given, **options):
        export(given, tmp_path / "plant.fmu", **options)
        options.pop("precision", None)
        export(given, tmp_path / "plant.npz", **options)
        fmpy.extract(str(tmp_path / "plant.fmu"), str(tmp_path / "fmu"))
        found.append(Instance(tmp_path / "fmu"))
        return found[-1], Controller.load(tmp_path / "plant.npz")

    yield open_one
    for each in found:
        each.fmu.freeInstance()


@needs_library
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", ["reactor", "two tanks, by a walk", "references and rates"])
def test_its_steps_are_the_controllers(name, precision, opened):
    policy = policy_of(name)
    checks, events = with_faults(policy, 300)
    instance, controller = opened(policy, checks=checks, precision=precision)
    met = Status(0)
    modes = set()
    kept = 0
    for k, (obs, elapsed, request, manual) in enumerate(events):
        controller.request = MODES[request]
        wanted = controller(obs, elapsed, manual)
        instance.give(obs, elapsed, request, manual)
        before = instance.outputs() if k % 3 else None
        instance.step()
        found, status, mode = instance.outputs()
        if before is not None:  # whoever reads before the step has what the step will say
            assert np.array_equal(before[0], found) and before[1:] == (status, mode)
        met |= controller.status
        modes.add(controller.mode)
        if precision == "float":  # at facets and limits float decides otherwise now and then
            kept += error(found, wanted, controller) < ROOM["float"]
            continue
        assert error(found, wanted, controller) < ROOM["double"], k
        assert (status, mode) == (int(controller.status), controller.mode), k
        kept += 1
    assert kept > 250 and modes == set(MODES)
    faults = Status.NOT_FINITE | Status.OUT_OF_RANGE | Status.FROZEN | Status.LATE
    assert met & faults == faults


@needs_library
def test_reading_and_setting_make_no_step(opened):
    policy = policy_of("reactor")
    instance, controller = opened(policy, checks=with_faults(policy, 200)[0])
    lost = [np.nan, 0.0, 0.0, -1.0]
    seen = [0.1, 0.0, 0.0, -1.0]
    for _ in range(10):  # more than `hold` of them
        instance.give(lost)
        assert instance.outputs()[2] == "mpc"
    instance.give(seen)
    found, *rest = instance.outputs()
    assert rest == [0, "policy"]
    assert error(found, controller(np.array(seen)), controller) < ROOM["double"]


@needs_library
def test_inputs_that_are_not_set_again_stay(opened):
    policy = policy_of("reactor")
    instance, controller = opened(policy, checks=with_faults(policy, 200)[0])
    lost = np.array([np.nan, 0.0, 0.0, -1.0])
    instance.give(lost)
    modes = []
    for _ in range(5):
        instance.step()
        controller(lost)
        modes.append(controller.mode)
        assert instance.outputs()[2] == controller.mode
    assert modes == ["mpc", "mpc", "manual", "manual", "manual"]
    instance.fmu.reset()
    instance.give([0.1, 0.0, 0.0, -5.0])
    wanted = controller.evaluate([0.1, 0.0, 0.0, -5.0])
    assert error(instance.outputs()[0], wanted, controller) < ROOM["double"]


@needs_library
def test_what_it_refuses(opened):
    instance, _ = opened(policy_of("reactor"))
    instance.step()
    for call in (
        lambda: instance.step(parts=0.5),
        lambda: instance.set("command[0]", 0.0),
        lambda: instance.fmu.getReal([999]),
    ):
        with pytest.raises(fmpy.fmi1.FMICallException, match="error"):
            call()


@needs_library
def test_a_wrong_identifier_is_no_instance(opened, tmp_path):
    opened(policy_of("reactor"))
    with pytest.raises(Exception, match="Failed to instantiate"):
        Instance(tmp_path / "fmu", guid="another")


@needs_library
def test_fmpy_validates_and_simulates_it(opened, tmp_path):
    instance, controller = opened(policy_of("reactor"))
    path = str(tmp_path / "plant.fmu")
    assert validate_fmu(path) == []
    obs = observations(policy_of("reactor"), 30)
    kinds = [("time", float), *((f"obs[{i}]", float) for i in range(4))]
    signal = np.array([(k * instance.dt, *row) for k, row in enumerate(obs)], kinds)
    found = fmpy.simulate_fmu(
        path, input=signal, stop_time=29 * instance.dt, output_interval=instance.dt,
        output=["command[0]"],
    )  # fmt: skip
    wanted = np.array([controller(row) for row in obs[:29]])
    assert error(found["command[0]"][1:, None], wanted, controller) < ROOM["double"]


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("prefix", [[], ["-DFMI2_FUNCTION_PREFIX=plant_"]])
def test_its_sources_compile_at_the_strictest(prefix, compiler, tmp_path):
    export(policy_of("reactor"), tmp_path / "plant.fmu")
    with zipfile.ZipFile(tmp_path / "plant.fmu") as archive:
        archive.extractall(tmp_path)
        listed = ElementTree.fromstring(archive.read("modelDescription.xml")).iter("File")
    sources = [str(tmp_path / "sources" / each.get("name")) for each in listed]
    built = [compiler, *STRICT, *prefix, "-shared", "-fPIC", *sources, "-lm", "-o"]
    done = subprocess.run([*built, str(tmp_path / "all.so")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (b"plant_fmi2DoStep" in (tmp_path / "all.so").read_bytes()) == bool(prefix)


def test_its_variables_have_the_units_and_limits_of_the_signals(tmp_path):
    model = LinearModel([[0.9]], [[0.5]], 2, x_ss=[12], u_ss=[3], units=["m", "L/min"],
                        state_names=["level"], input_names=["feed"], time_unit="min")  # fmt: skip
    box = {"u_min": 1, "u_max": 9, "theta_min": 2, "theta_max": 20}
    r = Tracking([0], 5, 15, preview=1)
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=2, tracking=r, **box)
    path = str(tmp_path / "plant.fmu")
    export(mpc, path, checks=Checks(obs_min=[0, 4, 4], obs_max=[25, 16, 16]))
    assert validate_fmu(path) == []
    said = fmpy.read_model_description(path)
    assert float(said.defaultExperiment.stepSize) == 120  # time is in seconds
    assert [each.name for each in said.unitDefinitions] == ["L/min", "m"]
    found = [(each.unit, each.min, each.max) for each in said.modelVariables if each.unit]
    assert found[:3] == [("m", "0.0", "25.0"), *[("m", "4.0", "16.0")] * 2]
    assert found[3:] == [("L/min", None, None), ("L/min", "1.0", "9.0")]


def test_without_a_compiler_it_holds_the_sources(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    for name in ("one", "two"):
        export(policy_of("reactor"), tmp_path / f"{name}.fmu", name="plant")
    with zipfile.ZipFile(tmp_path / "one.fmu") as archive:
        names = archive.namelist()
    units = ["plant.c", "plant.h", "plant_fmi2.c", "plant_fmi2.h"]
    assert sorted(names) == ["modelDescription.xml", *(f"sources/{each}" for each in units)]
    assert (tmp_path / "one.fmu").read_bytes() == (tmp_path / "two.fmu").read_bytes()


def test_a_compiler_that_fails_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(c_code, "COMPILERS", ("false",))
    monkeypatch.setitem(
        c_code.LIBRARIES, (platform.system(), platform.machine()), ("linux64", ".so")
    )
    with pytest.warns(RuntimeWarning, match="false failed"):
        export(policy_of("reactor"), tmp_path / "plant.fmu")
    with zipfile.ZipFile(tmp_path / "plant.fmu") as archive:
        assert not any("binaries" in each for each in archive.namelist())


SLOW = """#!/bin/sh
mktemp > /dev/null
echo $$ > "{0}"
sh -c 'echo $$ > "{0}.child"; mktemp > /dev/null; sleep 60' &
wait
"""


def test_an_interrupt_leaves_no_files_of_the_compiler_and_none_of_its_processes(tmp_path):
    temporary = tmp_path / "temporary"
    told = tmp_path / "told"
    temporary.mkdir()
    (tmp_path / "cc").write_text(SLOW.format(told))
    (tmp_path / "cc").chmod(0o755)
    program = (
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"  # as in front
        "from sb3_yann.deployment import c_code\nc_code._library({'a.c': 'int a;'})"
    )
    path = f"{tmp_path}:{os.environ['PATH']}"
    environment = {**os.environ, "TMPDIR": str(temporary), "PATH": path}
    running = subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE
    )
    child = Path(f"{told}.child")
    while running.poll() is None and not (child.exists() and child.read_text()):
        time.sleep(0.02)
    time.sleep(0.1)
    running.send_signal(signal.SIGINT)  # as Ctrl-C, but for the process group
    assert b"KeyboardInterrupt" in running.communicate(timeout=20)[1]
    assert [*temporary.iterdir()] == []
    for number in (told, child):
        assert not _is_running(int(number.read_text()))


def _is_running(number: int) -> bool:
    try:
        said = Path(f"/proc/{number}/stat").read_text()
    except OSError:
        return False
    return said.rpartition(")")[2].split()[0] not in "ZX"


class InALoop:
    """An instance, as the other forms of a whole controller are called."""

    def __init__(self, instance) -> None:
        self.instance = instance

    def begin(self) -> None:
        self.instance.fmu.reset()

    def step(self, obs, elapsed, request, manual):
        self.instance.give(obs, elapsed, request, manual)
        self.instance.step()
        command, status, mode = self.instance.outputs()
        return command, status, MODES.index(mode)


@needs_library
@pytest.mark.parametrize("extra", [False, True])
def test_with_its_estimator_it_is_the_controller_in_closed_loop(opened, extra):
    mpc, observer = problem(extra=extra)
    given = policy(extra=True) if extra else mpc
    checks = WITH_EXTRA if extra else CHECKS
    instance, controller = opened(given, estimator=observer, checks=checks)
    steps = noisy_steps(400)
    wanted, said = loop(InPython(controller), steps, extra)
    found, own = loop(InALoop(instance), steps, extra)
    np.testing.assert_allclose(found, wanted, atol=4e-10, rtol=0)
    assert own == said
