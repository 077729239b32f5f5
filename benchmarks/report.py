"""The report: ``performance.md``, and the lines that the README quotes."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

import sb3_yann
from benchmarks import evaluation, exactness, networks, offline, online, peers, simulators
from benchmarks.problems import PROBLEMS, SMALLEST
from benchmarks.records import Bench, Figure, Figures, heading, times
from benchmarks.sections import TITLES
from benchmarks.timing import ratios
from experiments.markdown import table

PACKAGES = ("numpy", "numba", "scipy", "torch", "stable-baselines3", "ppopt", "daqp", "osqp")
NOTES = {
    offline.SECTION: "ppopt's times are those of its solver alone, ours hold the check of every "
    "region as well. An algorithm that found another number of regions would have ended the run.",
    exactness.SECTION: "A third to a fifth of the points are random in the box, the others on "
    "faces of every dimension of all regions in turn, down to the vertices. Region by region they "
    "are looked for by a plain scan.",
    networks.TRAIN: "`model.train(1)` with a full replay buffer: critic, actor and both targets; "
    "every network has moved away from zero.",
    online.TRAIN: "As above, with a shared network. The law has been evaluated at all observations "
    "of the buffer before, as a policy does that has acted there.",
    online.EXACT: "Points are random, in the middle of the box, half as wide. The plan is solved "
    "for again, with the constraints that the law holds to be active, and its optimality checked.",
    evaluation.ONE: "All functions run on the same points, in the feasible part of the box; each "
    "one's answer was compared with ours before. daqp and osqp are set up once. The literal "
    f"network has {evaluation.LITERAL_WIDTH} nodes a region, ours 16 and 16 in training.",
}
LEGEND = (
    "Medians of the repeats, of the first row with its quartiles; after the colon how many times "
    "the first row's time that is, turn by turn."
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
    """Return the rows that the README quotes as well: how many times faster than the peers."""
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
        yield "law, one point, in numpy", [each.shown() if each else "" for each in own]
    for section, peer, name in lines:
        cells = []
        for size in sizes:
            ours, theirs = figures.get(section, "ours", size), figures.get(section, peer, size)
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
        f"{busy} What is compared was measured in turns, after a warm-up.\n\n"
        + table(("regions", "half-spaces", "problem"), rows, texts=0)
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
        note = NOTES.get(section, "")
        timed = any(each.kind == "time" for each in figures.of(section))
        legend = LEGEND if timed and section not in (simulators.SECTION,) else ""
        rows = [[name, *cells] for name, cells in figures.rows(section)]
        header = ["", *map(heading, figures.columns(section))]
        text = "\n\n".join(part for part in (note, legend, table(header, rows)) if part)
        yield f"## {TITLES[section]}\n\n{text}"
