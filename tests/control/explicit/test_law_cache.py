"""Laws on disk: the right one, for the same problem only, whatever stands in the folder."""

from __future__ import annotations

import dataclasses
import os
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fresh_process import run_python
from sample_problems import benchmark, small_mpc, solved
from sb3_yann import LinearMPC
from sb3_yann.control import PiecewiseAffine
from sb3_yann.control.explicit import law_cache
from sb3_yann.control.explicit import solve as module


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, which keeps every law."""
    monkeypatch.setenv("SB3_YANN_CACHE", str(tmp_path / "laws"))
    monkeypatch.setattr(module, "WORTH_KEEPING", 0.0)
    return tmp_path / "laws"


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """One entry for each time that regions are looked for."""
    find, calls = module._critical_regions, []
    monkeypatch.setattr(
        module, "_critical_regions", lambda *args: calls.append(args) or find(*args)
    )
    return calls


def test_a_law_is_read_back_bit_for_bit_and_not_solved_again(
    folder: Path, searches: list[Any]
) -> None:
    first, second = benchmark().explicit(), benchmark().explicit()
    assert first == second
    assert len(searches) == len(list(folder.iterdir())) == 1


def test_a_law_that_was_solved_at_once_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SB3_YANN_CACHE", str(tmp_path / "laws"))
    monkeypatch.setattr(module, "WORTH_KEEPING", 1000.0)
    benchmark().explicit()
    assert not (tmp_path / "laws").exists()


@pytest.mark.parametrize("value", ["off", "OFF", "0"])
def test_the_cache_can_be_turned_off(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, searches: list[Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_YANN_CACHE", value)
    monkeypatch.setattr(module, "WORTH_KEEPING", 0.0)
    benchmark().explicit()
    benchmark().explicit()
    assert len(searches) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"Q": np.diag([1, 2])},
        {"horizon": 3},
        {"x_max": 4},
        {"u_max": 2},
        {"theta_min": -4},
        {"gamma": 0.9},
        {"outside": "zero"},
        {"x_soft": [1.0, 0.0], "soft_penalty": 100.0},
    ],
)
def test_another_problem_has_another_file(
    changes: dict[str, Any], folder: Path, searches: list[Any]
) -> None:
    small_mpc().explicit()
    small_mpc(**changes).explicit()
    assert len(searches) == len(list(folder.iterdir())) == 2


def test_another_solver_has_another_file(folder: Path, searches: list[Any]) -> None:
    benchmark().explicit()
    benchmark().explicit("ppopt")
    assert len(searches) == len(list(folder.iterdir())) == 2


def damaged(path: Path, how: str) -> None:
    content = path.read_bytes()
    if how == "other law":
        law = solved("benchmark").explicit()
        dataclasses.replace(law, gains=1.01 * law.gains).save(path)
    elif how == "other problem":
        solved("one state").explicit().save(path)
    elif how == "other box":
        law = solved("benchmark").explicit()
        dataclasses.replace(law, theta_max=2 * law.theta_max).save(path)
    elif how == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        middle = len(content) // 2
        path.write_bytes({
            "empty": b"",
            "text": b"not a law",
            "half": content[:middle],
            "noise": content[: middle - 200] + 400 * b"\xaa" + content[middle + 200 :],
        }[how])  # fmt: skip


@pytest.mark.parametrize(
    "how",
    ["empty", "text", "half", "noise", "array", "other law", "other problem", "other box"],
)
def test_a_damaged_or_foreign_file_is_warned_of_and_written_anew(
    how: str, folder: Path, searches: list[Any]
) -> None:
    law = benchmark().explicit()
    (path,) = folder.iterdir()
    damaged(path, how)
    searches.clear()
    with pytest.warns(RuntimeWarning, match="is not used, and the problem is solved again"):
        assert benchmark().explicit() == law
    assert benchmark().explicit() == law  # no warning, which would be an error
    assert len(searches) == 1


def test_a_folder_where_the_file_should_be_does_no_harm(folder: Path) -> None:
    law = benchmark().explicit()
    (path,) = folder.iterdir()
    path.unlink()
    path.mkdir()
    assert benchmark().explicit() == law
    assert list(folder.iterdir()) == [path]


def test_a_place_that_cannot_be_written_to_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("SB3_YANN_CACHE", str(tmp_path / "file" / "laws"))
    monkeypatch.setattr(module, "WORTH_KEEPING", 0.0)
    assert benchmark().explicit() == solved("benchmark").explicit()


def test_the_home_of_a_user_who_is_not_there_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SB3_YANN_CACHE", "~no-such-user/laws")
    monkeypatch.setattr(module, "WORTH_KEEPING", 0.0)
    assert benchmark().explicit() == solved("benchmark").explicit()
    assert not list(tmp_path.iterdir())


def test_a_full_disk_does_no_harm_and_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(law: PiecewiseAffine, path: str) -> None:
        Path(path).write_bytes(b"PK")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(PiecewiseAffine, "save", save)
    assert benchmark().explicit() == solved("benchmark").explicit()
    assert list(folder.iterdir()) == []


def test_many_writers_and_readers_at_once_meet_whole_files_only(folder: Path) -> None:
    law = solved("benchmark").explicit()
    failures: list[str] = []

    def work() -> None:
        for _ in range(20):
            law_cache.store_law("key", law)
            if law_cache.load_law("key") != law:
                failures.append("another law")

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        threads = [threading.Thread(target=work) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert failures == []
    assert [path.name for path in folder.iterdir()] == ["key.npz"]


def test_another_process_reads_the_law(folder: Path) -> None:
    benchmark().explicit()
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]; sys.modules['daqp'] = __import__('daqp');"
        "from sb3_yann.control import explicit; explicit._critical_regions = None;"
        "from sample_problems import benchmark; sys.exit(benchmark().explicit().n_regions)"
    )
    assert run_python(code, str(Path(__file__).parent)).returncode == 9


@pytest.mark.skipif(sys.platform == "win32", reason="the folder of Linux and macOS")
def test_without_a_choice_the_folder_is_the_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SB3_YANN_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    chosen = law_cache.cache_folder()
    assert chosen is not None
    assert chosen.is_relative_to(tmp_path)
    assert chosen.name == "sb3-yann"
    assert not os.path.exists(chosen)


def test_negative_zero_is_zero_to_the_name_of_a_law() -> None:
    def name(mpc: LinearMPC, zero: float) -> str:
        program = mpc.condensed()
        program = dataclasses.replace(program, c=np.full_like(program.c, zero))
        return law_cache.cache_key(program, mpc.u_min, mpc.u_max, "nearest", "walk")

    assert name(small_mpc(), 0.0) == name(small_mpc(), -0.0)
    assert name(small_mpc(), 0.0) != name(small_mpc(), 1.0)
