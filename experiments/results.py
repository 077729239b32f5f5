"""The report: ``results.md`` with every table, next to its pictures."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

import sb3_yann
from experiments.markdown import number, table
from experiments.measures import OPTIMUM, OURS, Row, plants_of, standing
from experiments.pictures import save_in_short, save_pictures
from experiments.published import paper_table
from experiments.runner import Outcome, Run
from experiments.summary import summary

EPISODES = 50
LONG = 200
NOTES = Path(__file__).with_name("notes.md")
PACKAGES = ("stable-baselines3", "torch", "gymnasium", "numpy", "scipy", "ppopt")
CURVES = (
    "The line is the median over the seeds, the band goes from the first to the third quartile. "
    "Where the seeds were trained for different times, the curve ends with the shortest."
)
LEGEND = (
    "Mean cost over all test starts, median over the seeds [smallest, largest]; its "
    "interquartile mean (IQM) with the 95 % bootstrap interval over the seeds; *gap closed*: "
    f"of the way from the MPC to the {OPTIMUM}; *worst start*: the largest cost above the "
    "MPC's over all seeds and starts, and in per cent of the MPC's mean. *Excess cost*: what "
    "the training episodes cost, as played, above the MPC from the same starts."
)
Column = tuple[str, Callable[[Row], str]]


def write_report(
    outcomes: Mapping[Run, Outcome],
    folder: Path,
    *,
    command: str = "make paper",
    notes: Path = NOTES,
) -> list[Path]:
    """Write ``results.md`` and its pictures into `folder`, and return their paths.

    Learners and plants that are not there are left out. The text of `notes` is included as it is.
    """
    pictures = save_pictures(outcomes, folder)
    longest = max((run.episodes for run in outcomes), default=0)
    episodes = min(EPISODES, longest)  # fewer only in a quick form
    as_printed = [paper_table(outcomes, plant, episodes) for plant in plants_of(outcomes)]
    curves = [f"![{plant}]({path.name})" for plant, path in pictures.items()]
    parts = [
        "# Results",
        f"## In short\n\n{in_short(outcomes)}",
        how_it_was_made(outcomes, command),
        *_headed("## The paper's tables", as_printed),
        *_tables(outcomes, episodes, LEGEND),
        *_variants(outcomes, episodes),
        *_tables(outcomes, LONG),
        *_headed(f"## Learning curves\n\n{CURVES}", curves),
        notes.read_text(encoding="utf-8").strip() if notes.exists() else "",
    ]
    report = folder / "results.md"
    report.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return [report, *pictures.values(), *save_in_short(outcomes, folder)]


def in_short(outcomes: Mapping[Run, Outcome]) -> str:
    """Return the table that the README quotes as well."""
    longest = max((run.episodes for run in outcomes), default=0)
    return summary(outcomes, min(EPISODES, longest))


def how_it_was_made(outcomes: Mapping[Run, Outcome], command: str) -> str:
    """Return the section on the command, the versions and the time it took."""
    groups: dict[tuple[str, str, int], list[Outcome]] = {}
    for run, outcome in outcomes.items():
        groups.setdefault((run.plant, run.learner, run.episodes), []).append(outcome)
    rows = [
        [*key[:2], str(key[2]), str(len(of)), number(np.median([out.seconds for out in of]), 1)]
        for key, of in groups.items()
    ]
    hours = sum(outcome.seconds for outcome in outcomes.values()) / 3600
    starts = max((out.test_costs.shape[1] for out in outcomes.values()), default=0)
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    text = (
        f"Made with `{command}`: {len(outcomes)} runs, {hours:.1f} hours of one core altogether. "
        f"Every policy was tested on the same {starts} starts, without noise."
        f"\n\nPython {platform.python_version()} on {platform.system()}, "
        f"sb3-yann {sb3_yann.__version__}, {versions}.\n\n"
    )
    header = ("plant", "learner", "training episodes", "seeds", "seconds per run, median")
    return f"## How this was made\n\n{text}{table(header, rows, texts=2)}"


def _headed(heading: str, parts: list[str]) -> list[str]:
    return [heading, *parts] if any(parts) else []


def _tables(outcomes: Mapping[Run, Outcome], episodes: int, legend: str = "") -> list[str]:
    """Return the section of all learners after so many training episodes."""
    parts: list[str] = []
    for plant in plants_of(outcomes):
        rows, _ = standing(outcomes, plant, episodes).tables()
        learned = [row for row in rows if row.excess is not None]
        if learned:
            ours = next((row for row in rows if row.learner == OURS), None)
            tested = _cells(_test_columns("pendulum" in plant, ours), rows)
            taught = _cells(_training_columns(ours), learned)
            parts += [f"### {plant}", tested, "While learning:", taught]
    if not parts:
        return []
    return [f"## After {episodes} training episodes", legend, *parts]


def _variants(outcomes: Mapping[Run, Outcome], episodes: int) -> list[str]:
    parts: list[str] = []
    for plant in plants_of(outcomes):
        _, rows = standing(outcomes, plant, episodes).tables()
        if any(row.learner != OURS for row in rows):
            parts += [f"### {plant}, variants", _cells(_variant_columns(), rows)]
    return [f"## Variants of {OURS}, after {episodes} training episodes", *parts] if parts else []


def _test_columns(holds: bool, ours: Row | None) -> list[Column]:
    columns = [
        LEARNER,
        SEEDS_OF,
        MEAN,
        ("IQM, 95 %", _iqm),
        CHANGE,
        ("gap closed", lambda row: _percent(row.closed, 1)),
        BETTER,
        WORST,
        ("from the optimum", lambda row: number(row.distance)),
        (f"× {OURS}'s", lambda row: _ratio(row.distance, ours and ours.distance)),
        ("test episodes with violation", lambda row: str(row.unsafe_tests)),
    ]
    held: list[Column] = [
        ("held starts: worst", lambda row: number(row.held, 3, "+")),
        ("seeds within 10 % of optimum", lambda row: "—" if row.near is None else str(row.near)),
    ]
    return [*columns[:-1], *held] if holds else columns


def _training_columns(ours: Row | None) -> list[Column]:
    base = ours.excess[0] if ours and ours.excess else None
    return [
        LEARNER,
        SEEDS_OF,
        EXCESS,
        (f"× {OURS}'s", lambda row: _ratio(row.excess and row.excess[0], base)),
        UNSAFE,
    ]


def _variant_columns() -> list[Column]:
    return [LEARNER, SEEDS_OF, MEAN, CHANGE, BETTER, WORST, EXCESS, UNSAFE]


def _cells(columns: Sequence[Column], rows: Iterable[Row]) -> str:
    return table(
        [name for name, _ in columns], [[cell(row) for _, cell in columns] for row in rows]
    )


def _spread(row: Row) -> str:
    if row.seeds == 1:
        return number(row.median)
    return f"{number(row.median)} [{number(row.low)}, {number(row.high)}]"


def _iqm(row: Row) -> str:
    if row.interval is None:
        return "—"
    return f"{number(row.iqm)} ({number(row.interval[0])} to {number(row.interval[1])})"


def _percent(value: float | None, digits: int = 2, sign: str = "") -> str:
    return "—" if value is None else f"{number(value, digits, sign)} %"


def _worst(row: Row) -> str:
    if row.worst is None:
        return "—"
    return f"{number(row.worst, sign='+')} ({_percent(row.worst_share, sign='+')})"


def _excess(row: Row) -> str:
    if row.excess is None:
        return "—"
    median, low, high = (number(value, 1, "+") for value in row.excess)
    return f"{median} [{low}, {high}]"


def _ratio(value: float | None, base: float | None) -> str:
    """Return how many times `base` a value is; a ratio to nothing, or to less, says nothing."""
    return "—" if value is None or base is None or base <= 0 else number(value / base, 1)


LEARNER: Column = ("learner", lambda row: f"**{OURS}**" if row.learner == OURS else row.learner)
SEEDS_OF: Column = ("seeds", lambda row: str(row.seeds))
MEAN: Column = ("mean cost", _spread)
CHANGE: Column = ("against MPC", lambda row: _percent(row.change, sign="+"))
BETTER: Column = (
    "seeds better / worse",
    lambda row: "—" if row.below is None else f"{row.below} / {row.above}",
)
WORST: Column = ("worst start", _worst)
EXCESS: Column = ("excess cost", _excess)
UNSAFE: Column = ("training episodes with violation", lambda row: str(row.unsafe_training))
