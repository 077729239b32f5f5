"""The report: ``performance.md``."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import sb3_yann
from benchmarks import (
    deployment,
    evaluation,
    exactness,
    large,
    networks,
    offline,
    online,
    peers,
)
from benchmarks.problems import PROBLEMS, SMALLEST
from benchmarks.records import Bench, Figures, heading
from benchmarks.sections import TITLES
from experiments.markdown import table

PACKAGES = ("numpy", "numba", "scipy", "torch", "stable-baselines3", "ppopt", "daqp", "osqp")
ON_THE_PAGE = {
    evaluation.ONE: "",
    evaluation.MANY: "",
    networks.PREDICT: "",
    networks.TRAIN: "`model.train(1)` with a full replay buffer, no network at zero any more.",
    offline.SECTION: "ppopt's times are those of its solver alone, ours hold the check of every "
    "region as well.",
    exactness.SECTION: "A third to a fifth of the points are random in the box, the others on "
    "faces of every dimension of all regions.",
    large.SECTION: "",
    online.LAW: "",
    online.EXACT: "The plan is solved for again, and its optimality checked.",
    deployment.SECTION: "",
}
"""The sections of the page, and what each has to say; `make bench` prints all."""
PRINTED_ALONE = {evaluation.LOCATE, offline.EACH, peers.NO_OVERLAP, deployment.SINGLE}
"""Rows that `make bench` prints and the page leaves out."""
LEGEND = (
    "What is compared was measured in turns, after a warm-up, and its answers were compared first. "
    "Cells are medians; after a colon, how many times the first row's time that is, turn by turn. "
    "`make bench` prints more."
)


def write_report(bench: Bench, path: Path, command: str) -> None:
    """Write the report."""
    parts = ["# Performance", how_it_was_made(bench, command), *_sections(bench.figures)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def how_it_was_made(bench: Bench, command: str) -> str:
    """Return the section on the command, the machine, the versions and the problems."""
    share = bench.watch.share
    busy = "" if share > 0.9 else " Other processes were at work: the medians are too large."
    rows = [
        (f"{each.regions:,}", f"{each.law.n_halfspaces:,}", each.name)
        for each in ([SMALLEST] if bench.quick else PROBLEMS)
    ]
    return (
        f"## How this was made\n\nMade with `{command}` on {machine()}, one thread, "
        f"Python {platform.python_version()}, sb3-yann {sb3_yann.__version__}, {versions()}. "
        f"The process had a processor in {100 * share:.0f} % of the time of the measurements."
        f"{busy} {LEGEND}\n\n" + table(("regions", "half-spaces", "problem"), rows, texts=0)
    )


def machine() -> str:
    """Return the processor's name, as far as the system tells."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        name = next((x.partition(": ")[2] for x in lines if x.startswith("model name")), name)
    return f"{os.cpu_count()} cores of {name} under {platform.system()}"


def versions() -> str:
    """Return the versions of what is compared."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def _sections(figures: Figures) -> Iterator[str]:
    for section in figures.sections():
        if section not in ON_THE_PAGE:
            continue
        found = figures.rows(section, spread=False)
        rows = [[name, *cells] for name, cells in found if name not in PRINTED_ALONE]
        header = ["", *map(heading, figures.columns(section))]
        parts = (f"## {TITLES[section]}", ON_THE_PAGE[section], table(header, rows))
        yield "\n\n".join(filter(None, parts))
