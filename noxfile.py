"""The versions that sb3-yann is tested with, by nox: `pip install nox`.

nox -s "tests-3.11(pinned)" "tests-3.11(lowest)" "tests-3.11(newest)"
nox -s wheel        # the wheel alone in an empty environment
nox -s control      # models, MPC and law, which need no torch

`TORCH=2.13.0` pins torch, where only one build of it can be had.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import nox

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
ROOT = Path(__file__).parent
TORCH = os.environ.get("TORCH")
WITHOUT_TORCH = ("numpy", "scipy", "ppopt", "control", "daqp", "numba", "gymnasium", "tqdm", "rich")

nox.options.default_venv_backend = "venv"
nox.options.sessions = ["tests", "wheel", "control"]


def lowest() -> Iterator[str]:
    """Yield the lower bounds of pyproject.toml as exact versions, of what is always required."""
    project = nox.project.load_toml(ROOT / "pyproject.toml")["project"]
    for requirement in project["dependencies"]:
        name, version = re.match(r"([\w-]+)>=([\d.]+)", requirement).groups()
        if not (name == "torch" and TORCH):
            yield f"{name}=={version}"


def torch() -> list[str]:
    """Return the torch to install, if one is named."""
    return [f"torch=={TORCH}"] if TORCH else []


@nox.session(python=PYTHONS)
@nox.parametrize("versions", ["pinned", "lowest", "newest"])
def tests(session: nox.Session, versions: str) -> None:
    """Run the tests with the pinned, the lowest or the newest versions; -- goes to pytest."""
    if versions == "pinned":
        session.install("-c", "constraints.txt", *torch(), "-e", ".[dev]")
    elif versions == "lowest":
        session.install(*lowest(), *torch(), "-e", ".[dev]")
    else:
        session.install("--upgrade", "--upgrade-strategy=eager", *torch(), "-e", ".[dev]")
    session.run("python", "-m", "pip", "list")
    session.run(
        "python", "-m", "pytest", "-n", "logical", "--dist", "loadfile", *session.posargs,
        env={"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
    )  # fmt: skip


@nox.session(python=PYTHONS)
def wheel(session: nox.Session) -> None:
    """Build the wheel, install it alone, and use what it promises, away from the sources."""
    session.install("build")
    folder = Path(session.create_tmp()).resolve()
    session.run("python", "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT))
    (built,) = folder.glob("*.whl")
    session.run("python", "-m", "pip", "uninstall", "-y", "build")
    session.install(*torch(), str(built))
    session.chdir(folder)
    session.run("python", str(ROOT / "tests" / "support" / "installed.py"))
    session.run("sb3-yann", "--version")


@nox.session(python=PYTHONS)
def control(session: nox.Session) -> None:
    """Test models, MPC and law where there is no torch."""
    session.install("-c", "constraints.txt", *WITHOUT_TORCH, "pytest", "hypothesis")
    session.install("hatchling", "editables")
    session.install("--no-deps", "--no-build-isolation", "-e", ".")
    session.run("python", "-m", "pytest", "tests/control", *session.posargs)
