"""The report: ``performance.md``."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

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
from benchmarks.records import Bench, Figure, Figures, heading, times
from benchmarks.sections import TITLES
from benchmarks.timing import ratios
from experiments.markdown import table

PACKAGES = ("numpy", "numba", "scipy", "torch", "stable-baselines3", "ppopt", "daqp", "osqp")
ON_THE_PAGE = {
    evaluation.ONE: "",
    evaluation.MANY: "",
    networks.PREDICT: "",
    networks.TRAIN: "`model.train(1)` with a full replay buffer, no network at zero any more.",
    offline.SECTION: "ppopt's times are those of its solver alone, ours hold the check of every "
    "region as well. All find the same number of regions.",
    exactness.SECTION: "A third to a fifth of the points are random in the box, the others on "
    "faces of every dimension of all regions. A plain scan looks for them, region by region.",
    large.SECTION: "",
    online.LAW: "",
    online.EXACT: "The plan is solved for again, and its optimality checked.",
    deployment.SECTION: "",
}
"""The sections of the page, and what each has to say; `make bench` prints all."""
LEGEND = (
    "What is compared was measured in turns, after a warm-up, and its answers were compared first. "
    "Cells are medians; after a colon, how many times the first row's time that is, turn by turn. "
    "`make bench` prints the quartiles as well, and more sections."
)


def write_report(bench: Bench, path: Path, command: str) -> None:
    """Write the report."""
    short = in_short(bench.figures)
    parts = [
        "# Performance",
        f"## In short\n\n{short}" if short else "",
        how_it_was_made(bench, command),
        *_sections(bench.figures),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")


def in_short(figures: Figures) -> str:
    """Return the rows of the page's first table: how many times as long the peers take."""
    rows = [[name, *cells] for name, cells in _quoted(figures)]
    sizes = [column for column in figures.columns(evaluation.ONE) if column.isdigit()]
    return table(["", *map(heading, sizes)], rows) if rows and sizes else ""


def _quoted(figures: Figures) -> Iterator[tuple[str, list[str]]]:
    sizes = figures.columns(evaluation.ONE)
    lines = (
        (evaluation.ONE, peers.PPOPT, "law, one point: ppopt's evaluation takes"),
        (evaluation.ONE, peers.DAQP, "law, one point: an online QP (daqp) takes"),
        (evaluation.MANY, peers.LITERAL, "law, 256 points: the paper's network takes"),
        (networks.FORWARD_ONE, peers.MLP, "actor, one observation: a 256-256 MLP takes"),
        (networks.TRAIN, peers.MLP, "training step of DDPG: with 256-256 MLPs it takes"),
    )
    own = [figures.get(evaluation.ONE, "ours", size) for size in sizes]
    if any(own):
        cells = [each.shown(spread=False) if each else "" for each in own]
        yield "law, one point, in numpy", cells
    for section, peer, name in lines:
        cells = []
        for size in sizes:
            ours = figures.get(section, "ours", size)
            theirs = figures.get(section, peer, size)
            cells.append(_ratio(theirs, ours))
        if any(cells):
            yield name, cells


def _ratio(theirs: Figure | None, ours: Figure | None) -> str:
    if theirs is None or ours is None:
        return ""
    return times(float(np.median(ratios(theirs.samples, ours.samples))))


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
        rows = [[name, *cells] for name, cells in figures.rows(section, spread=False)]
        header = ["", *map(heading, figures.columns(section))]
        parts = (f"## {TITLES[section]}", ON_THE_PAGE[section], table(header, rows))
        yield "\n\n".join(part for part in parts if part)
