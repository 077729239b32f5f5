"""What is installed: the wheel's contents, its metadata, and how the packages import."""

import os
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import sb3_yann
from fresh_process import run_python

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"sb3_yann": ROOT / "sb3_yann", "sb3_yann_envs": ROOT / "envs" / "sb3_yann_envs"}
ROOMS = "audit callbacks control deployment evaluation guard networks policy wrappers".split()

# `import sb3_yann` alone loads next to nothing: names are loaded at their first use.
LOAD_ALL = {
    "sb3_yann": "import sb3_yann; [getattr(sb3_yann, name) for name in sb3_yann.__all__]; "
    + "; ".join(f"import sb3_yann.{room}" for room in ROOMS),
    "sb3_yann_envs": "import sb3_yann_envs; "
    "[getattr(sb3_yann_envs, name) for name in sb3_yann_envs.__all__]",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from hatchling.builders.wheel import WheelBuilder

    target = tmp_path_factory.mktemp("dist")
    (path,) = WheelBuilder(str(ROOT)).build(directory=str(target), versions=["standard"])
    return Path(path)


@pytest.fixture(scope="module")
def wheel_names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def metadata(wheel: Path, wheel_names: set[str]) -> Message:
    (name,) = (name for name in wheel_names if name.endswith(".dist-info/METADATA"))
    with zipfile.ZipFile(wheel) as archive:
        return Parser().parsestr(archive.read(name).decode())


@pytest.fixture(scope="module")
def sdist_names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    from hatchling.builders.sdist import SdistBuilder

    target = tmp_path_factory.mktemp("sdist")
    (path,) = SdistBuilder(str(ROOT)).build(directory=str(target), versions=["standard"])
    with tarfile.open(path) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


def test_the_sdist_holds_the_code_of_every_room_and_no_outcome_of_it(sdist_names: set[str]) -> None:
    rooms = ("sb3_yann", "envs", "benchmarks", "experiments", "examples", "tests")
    code = {path for room in rooms for path in (ROOT / room).rglob("*.py")}
    assert {path.relative_to(ROOT).as_posix() for path in code} <= sdist_names
    outcomes = [name for name in sdist_names if name.startswith(("benchmarks/", "experiments/"))]
    firmware = (".c", ".ld")  # around exported code, on an emulated microcontroller
    assert all(Path(name).suffix in (".py", *firmware) for name in outcomes)


def test_metadata(metadata: Message) -> None:
    assert metadata["Name"] == "sb3-yann"
    assert metadata["Version"] == sb3_yann.__version__
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.10"
    assert metadata.get_all("Provides-Extra") == "bench dev docs export paper pcgym zoo".split()


def test_the_wheel_holds_every_file_of_both_packages_and_nothing_else(
    wheel_names: set[str],
) -> None:
    expected = {
        f"{package}/{file.relative_to(folder).as_posix()}"
        for package, folder in PACKAGES.items()
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts and file.suffix != ".pyc"
    }
    found = {name for name in wheel_names if ".dist-info/" not in name}
    assert found == expected
    assert {"sb3_yann/py.typed", "sb3_yann_envs/py.typed"} <= found
    assert "sb3_yann/deployment/c/controller.c" in found
    assert [name for name in found if name.startswith("sb3_yann/hyperparams/")]
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in wheel_names)


def _pins() -> dict[str, str]:
    """Return the versions constraints.txt pins for this interpreter, by canonical name."""
    pins: dict[str, str] = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        pin = Requirement(text)
        (specifier,) = pin.specifier
        assert specifier.operator == "==", f"not an exact pin: {text}"
        if pin.marker is None or pin.marker.evaluate():
            name = canonicalize_name(pin.name)
            assert name not in pins, f"pinned twice: {text}"
            pins[name] = specifier.version
    return pins


def test_every_requirement_is_pinned_to_a_version_it_allows(metadata: Message) -> None:
    pins = _pins()
    for text in metadata.get_all("Requires-Dist", []):
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        if name == "sb3-yann":  # one extra naming another
            continue
        assert name in pins, f"constraints.txt does not pin {text}"
        assert requirement.specifier.contains(pins[name]), f"{text} rules out {pins[name]}"


@pytest.mark.parametrize(
    "package", [pytest.param("sb3_yann", marks=pytest.mark.slow), "sb3_yann_envs"]
)
def test_importing_prints_nothing_writes_no_file_and_compiles_nothing(
    package: str, tmp_path, monkeypatch
) -> None:
    # Matplotlib, which Stable-Baselines3 may load, keeps a font cache. Fill it first and
    # lend it, so that only what the package itself does can show.
    import matplotlib.font_manager

    folder = tmp_path / "empty"
    folder.mkdir()
    environment = {
        "HOME": str(folder),
        "MPLCONFIGDIR": matplotlib.get_cachedir(),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join(str(path.parent) for path in PACKAGES.values()),
        "TMPDIR": str(folder),
    }
    for name in [name for name in os.environ if name.startswith("XDG_")]:
        monkeypatch.delenv(name)
    program = f"{LOAD_ALL[package]}; import sys; print(*sys.modules, sep=',', end='')"
    printed, said = run_python(program, folder=folder, **environment)
    assert said == "" and printed.startswith("sys,") and "\n" not in printed
    assert list(folder.rglob("*")) == []
    if package == "sb3_yann":
        loaded = {*printed.split(",")}
        assert {"sb3_yann.networks.yann", *(f"sb3_yann.{room}" for room in ROOMS)} <= loaded
        assert not {"numba", "sb3_yann._numba"} & loaded
