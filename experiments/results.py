"""The report: ``results.md`` with every table, next to its pictures; the README's table."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import sb3_yann
from experiments.markdown import number, table
from experiments.measures import EXPLORED, MPC, OBSERVER, OPTIMUM, OURS, Row, plants_of, rows_of
from experiments.pictures import save_pictures
from experiments.published import paper_table
from experiments.runner import Outcome, Run

EPISODES = 50
LONG = (200, 500)
RIVAL = "DDPG"
NOTES = Path(__file__).with_name("notes.md")
PACKAGES = ("stable-baselines3", "torch", "gymnasium", "numpy", "scipy", "ppopt")
HEADER = ("learner", "seeds", "mean cost", "worst start, %", "excess cost")
LEGEND = (
    "*Mean cost* over all test starts: the median over the seeds (and the range). *Worst start*: "
    "the largest cost above the MPC's over all seeds and starts, in percent of the MPC's mean. "
    "*Excess cost*: what all training episodes together cost, as played, above the MPC from the "
    "same starts."
)
PUBLISHED = (
    "Mean costs of the first ten test episodes, before and after {} training episodes, with the "
    "first seed where no other is named. The paper's starts are not known."
)
CURVES = (
    "The median over the seeds, between the quartiles. Where they were trained for different "
    "times, the curve ends with the shortest."
)


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
    plants = plants_of(outcomes)
    episodes = min(EPISODES, max((run.episodes for run in outcomes), default=0))
    printed = paper_table(outcomes, episodes)
    curves = [f"![{plant}]({path.name})" for plant, path in pictures.items()]
    parts = [
        "# Results",
        how_it_was_made(outcomes, command),
        *_headed(f"## The paper's averages\n\n{PUBLISHED.format(episodes)}", [printed]),
        *_headed(
            f"## After {episodes} training episodes\n\n{LEGEND}",
            [_learner_table(outcomes, plant, episodes) for plant in plants],
        ),
        *_headed("## Longer training", [_longer_table(outcomes)]),
        *_headed(f"## Learning curves\n\n{CURVES}", curves),
        notes.read_text(encoding="utf-8").strip() if notes.exists() else "",
    ]
    report = folder / "results.md"
    report.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return [report, *pictures.values()]


def in_short(outcomes: Mapping[Run, Outcome]) -> str:
    """Return the README's table, with its legend."""
    episodes = min(EPISODES, max((run.episodes for run in outcomes), default=0))
    found = []
    for plant in plants_of(outcomes):
        rows = {row.learner: row for row in rows_of(outcomes, plant, episodes)}
        if OURS in rows or EXPLORED in rows:
            found.append(_short_row(plant, rows))
    if not found:
        return ""
    header = ("plant", OPTIMUM, MPC, OBSERVER, f"**{OURS}**, worst start", RIVAL)
    starts = max(len(out.test_costs[-1]) for out in outcomes.values())
    legend = (
        f"Mean cost of a test episode after {episodes} training episodes, over {starts} starts "
        "that training and guard never see: the median over the seeds (and the range). "
        f"**{OURS}**, the policy of this package under its guard, has one set of options for every "
        "plant and explores in a simulator. *Worst start*: by how much the cost of one start is "
        "above the MPC's at most, over all seeds. A dash: not run."
    )
    return f"{table(header, found)}\n\n{legend}"


def _short_row(plant: str, rows: Mapping[str, Row]) -> list[str]:
    ours = rows.get(EXPLORED) or rows[OURS]
    return [
        plant,
        *(_mean(rows.get(each)) for each in (OPTIMUM, MPC, OBSERVER)),
        f"**{_mean(ours)}**, {number(ours.worst, sign='+')}",
        _mean(rows.get(RIVAL)),
    ]


def how_it_was_made(outcomes: Mapping[Run, Outcome], command: str) -> str:
    """Return the section on the command, the versions and the time it took."""
    hours = sum(outcome.seconds for outcome in outcomes.values()) / 3600
    starts = max((out.test_costs.shape[1] for out in outcomes.values()), default=0)
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    return (
        f"## How this was made\n\nMade with `{command}`: {len(outcomes)} runs, {hours:.1f} hours "
        f"of one core. Every policy was tested on the same {starts} starts, without noise. "
        f"Python {platform.python_version()} on {platform.system()}, "
        f"sb3-yann {sb3_yann.__version__}, {versions}."
    )


def _headed(heading: str, parts: list[str]) -> list[str]:
    return [heading, *parts] if any(parts) else []


def _learner_table(outcomes: Mapping[Run, Outcome], plant: str, episodes: int) -> str:
    """Return the table of a plant; empty where nothing was learnt for so long."""
    rows = rows_of(outcomes, plant, episodes)
    if not any(row.excess is not None for row in rows):
        return ""
    return f"### {plant}\n\n{table(HEADER, map(_cells, rows))}{_beyond_limits(rows)}"


def _longer_table(outcomes: Mapping[Run, Outcome]) -> str:
    """Return what was learnt on all plants in more episodes; empty where nothing was."""
    found = {
        (plant, episodes): [r for r in rows_of(outcomes, plant, episodes) if r.excess is not None]
        for plant in plants_of(outcomes)
        for episodes in LONG
    }
    cells = [[at[0], str(at[1]), *_cells(row)] for at, rows in found.items() for row in rows]
    rows = [row for each in found.values() for row in each]
    return table(("plant", "episodes", *HEADER), cells) + _beyond_limits(rows) if cells else ""


def _cells(row: Row) -> list[str]:
    return [
        f"**{row.learner}**" if row.learner in (OURS, EXPLORED) else row.learner,
        str(row.seeds),
        _mean(row),
        number(row.worst_share, sign="+"),
        number(row.excess, 1, "+"),
    ]


def _beyond_limits(rows: Sequence[Row]) -> str:
    unsafe = "; ".join(
        f"{row.learner} {row.unsafe_training} (in tests {row.unsafe_tests})"
        for row in rows
        if row.unsafe_training or row.unsafe_tests
    )
    return f"\n\nEpisodes beyond a limit, over all seeds: {unsafe}." if unsafe else ""


def _mean(row: Row | None) -> str:
    if row is None:
        return "—"
    spread = f" ({number(row.low)} to {number(row.high)})" if row.seeds > 1 else ""
    return number(row.median) + spread
