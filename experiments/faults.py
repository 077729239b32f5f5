"""Kills, Ctrl-C, full disks and worse: `python -m experiments.faults`, an hour.

Each trial runs in a process of its own, which is killed at a random moment of what it writes; then
it is looked what is left. Faults of a plant or a simulator meet guarded training. Writes the tables
into docs/faults.md. It forks, so it needs Linux or macOS.
"""

from __future__ import annotations

import argparse
import re
import resource
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from stable_baselines3 import DDPG
from tqdm import tqdm

from experiments import killed_trainings as trainings
from experiments.children import end, fork
from experiments.endless_solver import ENDS, ended
from experiments.faulty_plants import ENV, PAIRS, met
from experiments.markdown import table
from experiments.runner import Outcome, Run, load, save
from experiments.summary import quote
from sb3_yann import Controller, export
from sb3_yann.commissioning.record import Record
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import problems

WRITE = 0.08
"""Seconds within which a writer is killed."""
ROOM = 3_000
"""Bytes that a full disk has left at most."""
RUN = Run("plant", "learner", 0, 0)


CODE = (".c", ".h", "_selftest.c")


class NoticedError(Exception):
    """What is there is not whole, and cannot be used by mistake."""


@dataclass(frozen=True)
class Target:
    """Something that writes versions of a file, and tells which one is there."""

    name: str
    write: Callable[[Path, int], None]
    read: Callable[[Path], int]
    grows: bool = False


@cache
def law(version: int) -> PiecewiseAffine:
    """Return the reactor's law, or that of other weights."""
    problem = problems.cstr()
    return replace(problem, R=(1 + version) * problem.R, terminal=None).explicit()


def write_law(folder: Path, version: int) -> None:
    """Save one of two laws."""
    law(version % 2).save(folder / "law.npz")


def read_law(folder: Path) -> int:
    """Return which of them is there, to the bit."""
    found = PiecewiseAffine.load(folder / "law.npz")
    return next(version for version in range(2) if law(version) == found)


def write_controller(folder: Path, version: int) -> None:
    """Export one of two laws."""
    export(law(version % 2), folder / "law.npz", name=f"v{version % 2}")


def read_controller(folder: Path) -> int:
    """Return which of them is there."""
    return int(str(Controller.load(folder / "law.npz").data["name"])[1:])


def write_code(folder: Path, version: int) -> None:
    """Export one of two laws to C."""
    export(law(version % 2), folder / "law.c", name=f"v{version % 2}")


def read_code(folder: Path) -> int:
    """Return which of them is there: all three files say it, or they do not compile."""
    texts = [(folder / f"law{name}").read_text(encoding="ascii") for name in CODE]
    marks = {re.findall(r"EXPORT_ID(?: !=)? (0x\w{8})u", text)[0] for text in texts}
    if len(marks) > 1:
        raise NoticedError("two exports, which do not compile")
    (version,) = {int("v1_" in text) for text in texts}
    return version


def write_run(folder: Path, version: int) -> None:
    """Save one of two outcomes."""
    none, costs = np.zeros(0), np.full((1, 100), float(version % 2))
    save(Outcome(np.zeros(1), costs, np.zeros((1, 100)), none, none, none), RUN, folder, "")


def read_run(folder: Path) -> int:
    """Return which of them is there."""
    found = load(RUN, folder, "")
    if found is None:
        raise ValueError("no whole run")
    return int(found.test_costs[0, 0])


def write_record(folder: Path, version: int) -> None:
    """Add an event to a record."""
    record = Record(folder / "plant.jsonl")
    record.append({"event": "episode" if record.events else "begin", "at": version})


def read_record(folder: Path) -> int:
    """Return the last event; none before it may be missing."""
    found = [event["at"] for event in Record(folder / "plant.jsonl").events]
    if found != [*range(len(found))]:
        raise ValueError(f"events {found}")
    return int(found[-1])


@cache
def model(version: int) -> DDPG:
    """Return a small model, or one of other weights."""
    return DDPG(
        "YannPolicy", ENV, device="cpu", seed=version, buffer_size=10,
        policy_kwargs={"critic_warmup": 50, "problem": problems.cstr()},
    )  # fmt: skip


def write_model(folder: Path, version: int) -> None:
    """Save one of two models, in place."""
    model(version % 2).save(folder / "model.zip")


def read_model(folder: Path) -> int:
    """Return which of them is there, to the bit; half a zip is refused."""
    try:
        found = DDPG.load(folder / "model.zip", device="cpu").policy.state_dict()
    except Exception as error:
        raise NoticedError("half a zip, which `load` refuses") from error
    wanted = [model(version).policy.state_dict() for version in range(2)]
    return next(
        version
        for version, each in enumerate(wanted)
        if all(torch.equal(each[name], found[name]) for name in each)
    )


TARGETS = (
    Target("`law.save`", write_law, read_law),
    Target("`export` to `.npz`", write_controller, read_controller),
    Target("`export` to C", write_code, read_code),
    Target("a run of `make paper`", write_run, read_run),
    Target("the record of `Commissioning`", write_record, read_record, grows=True),
    Target("`model.save`", write_model, read_model),
)


def killed(target: Target, sign: int, rng: np.random.Generator) -> str:
    """Return what is left of a writer that a signal meets at a random moment."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        target.write(folder, 0)
        child = fork(lambda: _for_ever(target, folder))
        time.sleep(rng.uniform(0, WRITE))
        hangs = end(child, sign) == "hangs"
        return "goes on, " * hangs + _left(target, folder)


def full(target: Target, rng: np.random.Generator) -> str:
    """Return what is left where there is no room for a file."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        target.write(folder, 0)
        room = int(rng.integers(0, ROOM))
        if target.grows:
            room = int(rng.integers(0, 60)) + (folder / "plant.jsonl").stat().st_size

        def write() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
            for version in range(1, 9):
                target.write(folder, version)

        said = end(fork(write))
        return f"{said}, {_left(target, folder)}"


def two_writers(target: Target, rng: np.random.Generator) -> str:
    """Return what is left of two processes that write the same file."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        target.write(folder, 0)
        both = [fork(lambda: _for_ever(target, folder)) for _ in range(2)]
        time.sleep(rng.uniform(0.5 * WRITE, 3 * WRITE))
        for child in both:
            end(child, signal.SIGKILL)
        return _left(target, folder)


def _for_ever(target: Target, folder: Path) -> None:
    version = 1
    while True:
        target.write(folder, version)
        version += 1


def _left(target: Target, folder: Path) -> str:
    try:
        target.read(folder)
    except NoticedError as error:
        return str(error)
    except Exception as error:
        return f"damaged ({type(error).__name__}: {error})"
    return "whole"


def trials(rng: np.random.Generator) -> dict[tuple[str, str], Callable[[], str]]:
    """Return a trial for each thing that is written, or goes on, and each fault."""
    found: dict[tuple[str, str], Callable[[], str]] = {}
    for target in TARGETS:
        ways: dict[str, Callable[[], str]] = {
            "kill -9": lambda t=target: killed(t, signal.SIGKILL, rng),
            "Ctrl-C": lambda t=target: killed(t, signal.SIGINT, rng),
            "a full disk": lambda t=target: full(t, rng),
            "two writers, both killed": lambda t=target: two_writers(t, rng),
        }
        if target.grows:  # one record belongs to one run, and a second one is refused by it
            del ways["two writers, both killed"]
        found |= {(target.name, way): trial for way, trial in ways.items()}
    learner, commissioned = cache(trainings.learner), cache(trainings.commissioned)
    return found | {
        ("guarded training", "Ctrl-C"): lambda: trainings.interrupted(rng, learner()),
        ("guarded training, saved and renamed", "kill -9"): lambda: trainings.killed(
            rng, learner()
        ),
        ("`Commissioning`", "kill -9"): lambda: trainings.cut_off(
            rng, learner(), *commissioned(learner())
        ),
    }


def rows(count: int, only: str, known: dict[tuple[str, str], list[str]]) -> Iterator[list[str]]:
    """Yield a row for each thing and each fault: what was left, how often.

    Parameters
    ----------
    count : int
        Trials of each.
    only : str
        Those are tried in whose names it is; "" is all.
    known : dict of (str, str) to list of str
        Rows that are there already, for the others.
    """
    rng = np.random.default_rng(0)
    for (what, fault), trial in trials(rng).items():
        if only in f"{what} | {fault}":
            yield row(what, fault, trainings.counted(trial, count))
        elif (what, fault) in known:
            yield known[what, fault]


def row(what: str, fault: str, found: Sequence[str]) -> list[str]:
    """Return a row: how often what was left."""
    print(what, fault, Counter(found), flush=True)
    counts = Counter(found).most_common()
    return [what, fault, f"{len(found)}", "; ".join(f"{n} {text}" for text, n in counts)]


def rows_of(page: Path) -> dict[tuple[str, str], list[str]]:
    """Return the rows of all tables of a page by their first two cells, and by the first alone."""
    lines = page.read_text(encoding="utf-8").splitlines() if page.exists() else []
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    several = [each for each in cells if len(each) > 1]
    return {(each[0], ""): each for each in several} | {
        (each[0], each[1]): each for each in several
    }


def tables(count: int, only: str, known: dict[tuple[str, str], list[str]]) -> dict[str, str]:
    """Return all tables by their marks; arguments as those of `rows`."""
    kills = rows(count, only, known)
    plants = (
        [way, where, *met(way, where)]
        if only in f"{way} | {where}"
        else known.get((way, where), [way, where, "not tried", "not tried"])
        for way, where in PAIRS
    )
    laws = (
        [way, *ended(way)] if only in way else known.get((way, ""), [way, "", "not tried"])
        for way in ENDS
    )
    return {
        "kills": table(("what", "fault", "trials", "left"), kills, texts=4),
        "plants": table(("the env", "in", "what is said", "policy afterwards"), plants, texts=4),
        "laws": table(("a law of too many regions", "seconds", "what is said"), laws, texts=3),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Try all faults, print the tables and quote them."""
    parser = argparse.ArgumentParser(prog="python -m experiments.faults", description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="of each thing and fault")
    parser.add_argument("--only", default="", help="rows that hold this in their first cells")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    # tqdm's own lock is shared with children, and one that is killed keeps it.
    tqdm.set_lock(threading.RLock())
    for version in range(2):
        law(version), model(version)  # children find them solved
    page = options.report / "faults.md"
    for mark, text in tables(options.trials, options.only, rows_of(page)).items():
        print(text)
        if quote(text, page, f"<!-- {mark}: begin -->\n", f"<!-- {mark}: end -->"):
            print(f"Written: {page}")
    print("Commissionings were killed at", dict(trainings.MOMENTS))


if __name__ == "__main__":
    main()
