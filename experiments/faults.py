"""Kills, Ctrl-C, full disks and worse: `python -m experiments.faults`, a quarter of an hour.

Each trial runs in a process of its own, which is killed at a random moment of what it writes; then
it is looked what is left. Faults of a plant or a simulator meet guarded training. Writes the tables
into docs/faults.md. It forks, so it needs Linux or macOS.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import signal
import threading
import time
import warnings
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

from experiments.faulty_plants import ENV, WAYS, WHERE, met
from experiments.markdown import table
from experiments.runner import Outcome, Run, load, save
from experiments.summary import quote
from sb3_yann import Commissioning, Controller, ImprovementGuard, NoActionNoise, export
from sb3_yann.commissioning.record import Record
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import problems

WRITE, TRAIN = 0.08, 4.0
"""Seconds within which a writer, and a training, is killed."""
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


TARGETS = (
    Target("`law.save`", write_law, read_law),
    Target("`export` to `.npz`", write_controller, read_controller),
    Target("`export` to C", write_code, read_code),
    Target("a run of `make paper`", write_run, read_run),
    Target("the record of `Commissioning`", write_record, read_record, grows=True),
)


def killed(target: Target, sign: int, rng: np.random.Generator) -> str:
    """Return what is left of a writer that a signal meets at a random moment."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        target.write(folder, 0)
        child = _fork(lambda: _for_ever(target, folder))
        time.sleep(rng.uniform(0, WRITE))
        hangs = _end(child, sign) == "hangs"
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

        said = _end(_fork(write))
        return f"{said}, {_left(target, folder)}"


def two_writers(target: Target, rng: np.random.Generator) -> str:
    """Return what is left of two processes that write the same file."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        target.write(folder, 0)
        both = [_fork(lambda: _for_ever(target, folder)) for _ in range(2)]
        time.sleep(rng.uniform(0.5 * WRITE, 3 * WRITE))
        for child in both:
            _end(child, signal.SIGKILL)
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


def training(sign: int, rng: np.random.Generator, model: DDPG) -> str:
    """Return what Ctrl-C leaves of guarded training: the accepted policy, or another."""
    with TemporaryDirectory() as name:
        folder = Path(name)

        def learn() -> None:
            guard = ImprovementGuard(ENV, n_starts=3, n_new_starts=3, n_final_starts=3)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    model.learn(4_000, callback=[NoActionNoise(), guard])
                except KeyboardInterrupt:
                    pass
            if hasattr(model, "guard_state"):
                saved = [each.clone() for each in model.actor.state_dict().values()]
                model.guard_state.accepted.restore(model.policy)
                kept = [*model.actor.state_dict().values()]
                same = all(torch.equal(*pair) for pair in zip(saved, kept, strict=True))
                (folder / ("the accepted policy" if same else "another policy")).touch()
            else:
                (folder / "not begun").touch()

        child = _fork(learn)
        time.sleep(rng.uniform(0, TRAIN))
        _end(child, sign)
        return next((each.name for each in folder.iterdir()), "not begun")


def commissioning(rng: np.random.Generator, model: DDPG) -> str:
    """Return whether a commissioning goes on after a kill."""
    with TemporaryDirectory() as name:
        folder = Path(name)

        def run() -> None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                Commissioning(
                    model, ENV, batch=2, iterations=3, log_path=folder / "record", shadow=True
                ).run(1)

        child = _fork(run)
        time.sleep(rng.uniform(0, TRAIN))
        _end(child, signal.SIGKILL)
        end = _end(_fork(run), patience=120)
        return "goes on to its end" if end == "done" else f"going on: {end}"


def _fork(work: Callable[[], None]) -> int:
    """Return the process that does some work; it exits with 0, or with 1 after an error."""
    # A signal waits until the child can meet it: before, it would be lost or end the parent's work.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return child
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever forks may ignore it
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        work()
        code = 0
    except BaseException:
        code = 1
    finally:
        os._exit(code)


def _end(child: int, sign: int | None = None, patience: float = 30) -> str:
    """Send a signal to a process, wait for its end, and say how that was."""
    if sign is not None:
        os.kill(child, sign)
    until = time.monotonic() + patience
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return {0: "done", 1: "an error"}.get(code, f"signal {-code}")
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hangs"


def rows(trials: int, trainings: int) -> Iterator[list[str]]:
    """Yield a row for each thing that is written and each fault: what was left, how often."""
    rng = np.random.default_rng(0)
    for target in TARGETS:
        ways: dict[str, Callable[[], str]] = {
            "kill -9": lambda t=target: killed(t, signal.SIGKILL, rng),
            "Ctrl-C": lambda t=target: killed(t, signal.SIGINT, rng),
            "a full disk": lambda t=target: full(t, rng),
            "two writers, both killed": lambda t=target: two_writers(t, rng),
        }
        if target.grows:  # one record belongs to one run, and a second one is refused by it
            del ways["two writers, both killed"]
        for way, trial in ways.items():
            yield row(target.name, way, [trial() for _ in range(trials)])
    model = DDPG("YannPolicy", ENV, device="cpu", seed=0, policy_kwargs={"critic_warmup": 50})
    found = [training(signal.SIGINT, rng, model) for _ in range(trainings)]
    yield row("guarded training", "Ctrl-C", found)
    yield row("`Commissioning`", "kill -9", [commissioning(rng, model) for _ in range(trainings)])


def row(what: str, fault: str, found: Sequence[str]) -> list[str]:
    """Return a row: how often what was left."""
    print(what, fault, Counter(found), flush=True)
    counts = Counter(found).most_common()
    return [what, fault, f"{len(found)}", "; ".join(f"{n} {text}" for text, n in counts)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Try all faults, print the tables and quote them."""
    parser = argparse.ArgumentParser(prog="python -m experiments.faults", description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="of each writer and fault")
    parser.add_argument("--trainings", type=int, default=200, help="that are killed")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    tqdm.set_lock(
        threading.RLock()
    )  # its own is shared with children, and one that is killed keeps it
    for version in range(2):
        law(version)  # children find them solved
    killed_ones = table(
        ("what", "fault", "trials", "left"), rows(options.trials, options.trainings), texts=4
    )
    plants = [[way, where, *met(way, where)] for way in WAYS for where in WHERE]
    found = table(("the env", "in", "what is said", "policy afterwards"), plants, texts=4)
    page = options.report / "faults.md"
    for mark, text in (("kills", killed_ones), ("plants", found)):
        print(text)
        if quote(text, page, f"<!-- {mark}: begin -->\n", f"<!-- {mark}: end -->"):
            print(f"Written: {page}")


if __name__ == "__main__":
    main()
