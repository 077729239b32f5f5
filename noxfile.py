"""The versions that sb3-yann is tested with. nox makes an environment for each.

nox --list
nox -s "tests-3.11(lowest)" -- -m "not slow"   # pinned, lowest or newest; the rest goes to pytest
nox -s wheel-3.11      # the wheel alone in an empty environment
nox -s control-3.13    # models, MPC, law and environments, where there is no torch

`TORCH=2.13.0 nox ...` takes that torch, where only one build of it can be had.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import nox
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parent.resolve()
PROJECT = nox.project.load_toml(ROOT / "pyproject.toml")["project"]
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
VERSIONS = ["pinned", "lowest", "newest"]
TORCH = os.environ.get("TORCH")
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
TESTED = ("bench", "export", "zoo", "dev")
"""The extras that the tests need. `paper` asks for a newer scipy than the package does."""
NEED_TORCH = {"stable-baselines3", "torch", "tensorboard"}
WITHOUT_TORCH = ("tests/control", "tests/envs", "tests/test_archive.py", "tests/test_validation.py")

nox.options.default_venv_backend = "venv"
nox.options.sessions = ["tests", "wheel", "control"]


def required(python: str, *extras: str) -> list[Requirement]:
    """Return what pyproject.toml asks for on a Python, with some extras."""
    optional = PROJECT["optional-dependencies"]
    texts = PROJECT["dependencies"] + [text for extra in extras for text in optional[extra]]
    found = [Requirement(text) for text in texts]
    return [
        each
        for each in found
        if each.name != PROJECT["name"]  # one extra naming another
        and (each.marker is None or each.marker.evaluate({"python_version": python}))
    ]


def lowest(requirements: Iterable[Requirement]) -> list[str]:
    """Return the lower bounds as exact versions; of two for one name, the higher."""
    bounds: dict[str, Version] = {}
    for each in requirements:
        name = canonicalize_name(each.name) + "".join(f"[{extra}]" for extra in each.extras)
        (bound,) = (Version(part.version) for part in each.specifier if part.operator == ">=")
        bounds[name] = max(bound, bounds.get(name, bound))
    if TORCH and "torch" in bounds:
        bounds["torch"] = Version(TORCH)
    return [f"{name}=={bound}" for name, bound in bounds.items()]


def torch() -> list[str]:
    """Return the torch to install, if one is named."""
    return [f"torch=={TORCH}"] if TORCH else []


@nox.session(python=PYTHONS)
@nox.parametrize("versions", VERSIONS, ids=VERSIONS)
def tests(session: nox.Session, versions: str) -> None:
    """Run the tests with the pinned, the lowest or the newest versions."""
    if versions == "pinned":
        session.install("-c", "constraints.txt", *torch(), "-e", ".[dev]")
    elif versions == "lowest":
        session.install(*lowest(required(str(session.python), *TESTED)), "-e", ".")
    else:
        session.install("--upgrade", "--upgrade-strategy=eager", *torch(), "-e", ".[dev]")
    session.run("python", "-m", "pip", "list")
    parallel = ("-n", "logical", "--maxprocesses", "4", "--dist", "loadfile")
    session.run("python", "-m", "pytest", *parallel, *session.posargs, env=ENVIRONMENT)


@nox.session(python=PYTHONS)
def wheel(session: nox.Session) -> None:
    """Build the wheel, install it alone, and use what it promises, away from the sources."""
    folder = Path(session.create_tmp()).resolve()
    for old in folder.glob("*.whl"):
        old.unlink()
    pip = ("python", "-m", "pip", "wheel", "--quiet", "--no-deps")
    session.run(*pip, "--wheel-dir", str(folder), str(ROOT))
    (built,) = folder.glob("*.whl")
    session.install("--force-reinstall", "--no-deps", str(built))
    session.install(*torch(), str(built))
    session.chdir(folder)
    # -I: neither the folder of the script nor PYTHONPATH is searched.
    session.run("python", "-I", str(ROOT / "tests" / "support" / "installed.py"), env=ENVIRONMENT)
    session.run("sb3-yann", "--version")
    session.run("sb3-yann", "--help", silent=True)


@nox.session(python=PYTHONS)
@nox.parametrize("versions", VERSIONS, ids=VERSIONS)
def control(session: nox.Session, versions: str) -> None:
    """Test what needs no torch where there is none."""
    needed = [each for each in required(str(session.python)) if each.name not in NEED_TORCH]
    tools = ["pytest", "pytest-xdist", "hypothesis", "cloudpickle"]
    if versions == "lowest":
        session.install(*lowest(needed), *tools)
    else:
        how = ("-c", "constraints.txt") if versions == "pinned" else ("--upgrade",)
        session.install(*how, *(f"{each.name}{each.specifier}" for each in needed), *tools)
    session.install("--no-deps", "-e", ".")
    absent = "import importlib.util as u, sys; sys.exit(u.find_spec('torch') is not None)"
    session.run("python", "-c", absent)
    session.run("python", "-m", "pip", "list")
    session.run("python", "-m", "compileall", "-q", "sb3_yann", "envs")
    session.run("python", "-m", "pytest", *WITHOUT_TORCH, *session.posargs, env=ENVIRONMENT)
