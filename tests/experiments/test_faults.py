"""A few of the trials of docs/faults.md, and that a writer without care would be found out."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("resource")
from experiments import faults
from experiments.faulty_plants import met
from experiments.killed_trainings import counted


@pytest.mark.parametrize("target", faults.TARGETS, ids=lambda each: each.name)
def test_what_is_hit_while_it_is_written_is_whole(target):
    rng = np.random.default_rng(1)
    for version in range(2):
        (
            faults.law(version),
            faults.model(version),
        )  # a child that is killed while it solves would keep tqdm's lock
    refused = "half a zip, which `load` refuses"
    harmless = {"whole", "two exports, which do not compile"}
    if target.name == "`model.save`":  # Stable-Baselines3's
        harmless |= {refused}
    for sign in (signal.SIGKILL, signal.SIGINT):
        assert {faults.killed(target, sign, rng) for _ in range(3)} <= harmless
    assert faults.full(target, rng) in {f"an error, {each}" for each in harmless}


def test_trials_that_hit_nothing_do_not_count():
    found = iter(["not begun", "whole", "it was through", "whole"])
    assert counted(lambda: next(found), 2) == ["whole", "whole"]
    with pytest.raises(RuntimeError, match="hit nothing"):
        counted(lambda: "not begun", 1)


def test_rows_that_are_not_tried_again_stay(tmp_path: Path):
    page = tmp_path / "faults.md"
    page.write_text("| `law.save` | kill -9 | 7 | 7 whole |\n")
    rows = [*faults.rows(1, "of no name", faults.rows_of(page))]
    assert rows == [["`law.save`", "kill -9", "7", "7 whole"]]


def test_a_writer_without_care_is_found_out():
    def write(folder: Path, version: int) -> None:
        with (folder / "file").open("w") as file:
            for _ in range(200):
                file.write(f"{version % 2}")
                file.flush()
                os.fsync(file.fileno())

    def read(folder: Path) -> int:
        text = (folder / "file").read_text()
        assert len(text) == 200 and len(set(text)) == 1, "half"
        return int(text[0])

    careless, rng = faults.Target("careless", write, read), np.random.default_rng(2)
    found = [faults.killed(careless, signal.SIGKILL, rng) for _ in range(8)]
    assert any(each.startswith("damaged") for each in found)


def test_a_simulator_that_fails_is_named_and_the_mpc_stays():
    said, policy = met("raises an error", "training")
    assert "RuntimeError: the simulator has lost its licence" in said
    assert policy in ("the MPC", "the accepted one")
