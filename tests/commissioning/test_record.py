"""A record that was changed is refused; one that a kill cut off goes on."""

import errno
import json
import os
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from resumed import all_bits, envs, model_bits
from sb3_yann import Commissioning, Improvement, YannPolicy, improve
from sb3_yann.commissioning import commissioning
from sb3_yann.commissioning.commissioning import why_taken_back
from sb3_yann.commissioning.journal import Accepted, CommissioningState, Journal, Record
from sb3_yann.commissioning.plant import PlantEpisode
from sb3_yann.commissioning.watchdog import Alarm
from sb3_yann.improvement import Check
from twin_samples import Cart

SETTINGS = {"batch": 5, "problem": "abc"}


def journal(path: Path) -> Journal:
    return Journal(Record(path), SETTINGS, CommissioningState(0.1))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = journal(tmp_path / "plant.jsonl")
    for reward in (1.5, float("nan")):
        alarm = None if reward == 1.5 else Alarm("violation", "x[0] = 3 > 2 °C")
        found.begin(False)
        played = np.eye(3)[:, :2], np.array([[0.1], [0.2]])
        found.add(PlantEpisode(*played, reward, 0, alarm, 0.1, 0.0), False)
    return found.record.path


def test_it_reads_what_it_wrote(path: Path) -> None:
    again = journal(path)
    assert again.episodes[0].reward == 1.5
    assert again.episodes[1].alarm.message == "x[0] = 3 > 2 °C"
    assert len(Record(path).events) == 5
    again.begin(False)
    assert len(Record(path).events) == 6
    assert not again.record.events  # the episodes hold them


@pytest.mark.parametrize(
    "change",
    [
        lambda lines: [lines[0], *lines[3:]],
        lambda lines: [*lines[:2], lines[4], lines[3], lines[2]],
        lambda lines: [*lines, 100_000 * "["],
        lambda lines: [*lines, "\ufeff"],
        lambda lines: [*lines, "[1, 2]"],
    ],
    ids=["left out", "swapped", "brackets", "a mark", "a list"],
)
def test_a_record_that_was_edited_is_refused(change, path: Path) -> None:
    lines = change(path.read_text("utf-8").splitlines())
    path.write_text("\n".join(lines) + "\n", "utf-8")
    with pytest.raises(ValueError, match=r"plant\.jsonl, line \d: no event .*Name anot"):
        journal(path)


@pytest.mark.parametrize(
    "event",
    [{"event": "episode"}, {"event": "start"}, {"event": "batch", "number": 1},
     {"event": "episode", "acts": "MPC", "alarm": 3, "reward": "x"}],
)  # fmt: skip
def test_an_event_without_its_parts_is_refused(event, path: Path) -> None:
    Record(path).append(event)
    with pytest.raises(ValueError, match=r"plant\.jsonl, line 6: no event"):
        journal(path)


def test_a_cut_at_any_place_leaves_whole_lines(path: Path) -> None:
    content = path.read_bytes()
    events = Record(path).events
    for end in range(len(content)):
        path.write_bytes(content[:end])
        assert Record(path).events == events[: content[:end].count(b"\n")]


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
@pytest.mark.parametrize("written", [True, False], ids=["written", "not written"])
def test_after_a_full_disk_or_ctrl_c_the_same_run_goes_on(
    fault: BaseException, written: bool, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise fault

    again = journal(path)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", fail) if written else patched.setattr(Path, "open", fail)
        with pytest.raises(type(fault), match=r"goes on from there|^$"):
            again.begin(True)
    again.begin(False)
    assert [each["event"] for each in Record(path).events[5:]] == ["start"]
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(RuntimeError, match="was changed by somebody else"):
        again.begin(False)


def test_an_episode_that_a_full_disk_has_no_room_for_is_not_held_against_the_policy(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [OSError(errno.ENOSPC, "full")]

    def fail_once(*_: object) -> None:
        if full:
            raise full.pop()

    again = journal(path)
    again.state = replace(again.state, acting=Accepted("batch 1"))
    again.begin(True)
    monkeypatch.setattr(os, "fsync", fail_once)
    with pytest.raises(OSError, match="could not be written"):
        again.add(again.episodes[0], True)
    assert again.cut_off == journal(path).cut_off == 0


class Unsaved:
    """A model whose save is cut off, or is done."""

    def __init__(self, fault: BaseException | None) -> None:
        self.fault = fault

    def save(self, path: Path) -> None:
        path.write_bytes(b"weights")
        if self.fault is not None:
            raise self.fault


def test_a_model_is_on_the_disk_before_the_line_that_names_it(path: Path, monkeypatch) -> None:
    synced = []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(os.fstat(number).st_ino))
    saved = path.with_name(Record(path).save(Unsaved(None), 1))
    assert synced == [saved.stat().st_ino]
    with pytest.raises(OSError, match="full"):
        Record(path).save(Unsaved(OSError("full")), 2)
    assert {each.name for each in path.parent.iterdir()} == {path.name, saved.name}


STEPS = 20
"""Of an episode in training; on the plant they are twice as long."""


class Short(Cart):
    """Short episodes of the cart, from where the MPC always comes back."""

    def __init__(self, steps: int = STEPS) -> None:
        super().__init__(steps)

    def reset(self, **options):
        super().reset(**options)
        self.x = self.x * [0.6, 1.0]
        return self.x.astype(np.float32), {}


def model(n_envs: int = 1, **options: Any) -> DDPG:
    options = {"seed": 0, "device": "cpu", "buffer_size": 1000, "batch_size": 16} | options
    return DDPG(YannPolicy, envs(n_envs, Short), **options)


def commission(path: Any, learner: DDPG | None = None) -> Commissioning:
    learner = model() if learner is None else learner
    options = {"batch": 4, "updates": 500, "max_correction": 0.2}
    return Commissioning(
        learner, partial(Short, 2 * STEPS), log_path=path / "plant.jsonl", **options
    )


def events(path: Any) -> list[dict[str, Any]]:
    """Return a record but for its checksums."""
    found = [json.loads(line) for line in (path / "plant.jsonl").read_text().splitlines()]
    for each in found:
        del each["crc32"]
    return found


@pytest.mark.nightly
def test_a_commissioning_that_stops_after_a_batch_goes_on_as_if_it_had_not(
    tmp_path, monkeypatch
) -> None:
    unsafe = Check(0, False, "start 3 violates a limit", 0.0, 0.0, False)
    found = Improvement((unsafe,), 0.0, False, unsafe)

    def refuse_second(*args: Any, **options: Any) -> Improvement:
        return found if options["seed"] == 2 else improve(*args, **options)

    monkeypatch.setattr(commissioning, "improve", refuse_second)
    outcomes = []
    for name in ("whole", "cut"):
        run = commission(tmp_path / name)
        for batches in (1, 2, 3):
            run = commission(tmp_path / name) if name == "cut" else run
            run.run(batches)
        verdicts = [each.verdict for each in run.batches]
        assert verdicts == ["the MPC acts", "the MPC acts", "accepted"]
        trained = model_bits(run.model), run.policy.max_correction, all_bits(run.batches)
        outcomes.append([*trained, events(tmp_path / name)])
    assert outcomes[0] == outcomes[1]
    again = commission(tmp_path / "cut")
    assert model_bits(again.model) == outcomes[0][0]


def test_what_the_model_had_learnt_before_still_waits_after_a_stop(tmp_path, monkeypatch) -> None:
    def learnt() -> DDPG:
        found = model()
        with th.no_grad():
            for each in found.policy.actor.parameters():
                each.add_(0.01)
        return found

    monkeypatch.setattr(commissioning, "why_taken_back", lambda *_: "a test")
    first = commission(tmp_path, learnt())
    first.run(1)
    again = commission(tmp_path, learnt())
    assert all_bits(again.candidate) == all_bits(first.candidate)
    assert again.candidate is not None
    monkeypatch.setattr(commissioning, "why_taken_back", why_taken_back)
    again.run(2)
    assert commission(tmp_path, learnt()).candidate is None  # it has been tried


def test_ctrl_c_while_an_event_is_noted_waits_until_it_holds(tmp_path, monkeypatch) -> None:
    append = Record.append

    def append_and_interrupt(record: Record, event: dict[str, Any]) -> None:
        append(record, event)
        if event["event"] in ("episode", "batch"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Record, "append", append_and_interrupt)
    monkeypatch.setattr(commissioning, "why_taken_back", lambda *_: "a test")
    run = commission(tmp_path)
    for _ in range(5):
        with pytest.raises(KeyboardInterrupt):
            run.run(1)
    kinds = [each["event"] for each in events(tmp_path)]
    assert kinds == ["begin", *(4 * ["start", "episode"]), "batch"]
    assert len(run.episodes) == 4 and run.twin is not None and run.watchdog is not None


def test_a_second_run_on_a_record_is_refused_before_it_plays(tmp_path) -> None:
    run = commission(tmp_path)
    with Record(run.journal.record.path).locked():
        with pytest.raises(RuntimeError, match=r"plant\.jsonl.* End that one, or name another"):
            run.run(1)
    assert [each["event"] for each in events(tmp_path)] == ["begin"]
    with run.journal.record.locked():
        pass
