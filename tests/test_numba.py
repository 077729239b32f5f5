"""The stamp of kept machine code covers every file with compiled functions."""

import re
from pathlib import Path

from numba.core.dispatcher import Dispatcher

import sb3_yann
from sb3_yann._numba import _say, compiled, compiled_sources

PACKAGE = Path(sb3_yann.__file__).parent


def test_the_stamp_covers_every_file_that_imports_the_decorator_and_the_decorator_s_own() -> None:
    uses = re.compile(r"from sb3_yann\._numba import .*\bcompiled\b")
    expected = {each for each in PACKAGE.rglob("*.py") if uses.search(each.read_text("utf-8"))}
    assert len(expected) >= 5
    assert set(compiled_sources(PACKAGE)) == expected | {PACKAGE / "_numba.py"}


def test_a_file_that_moves_or_is_new_is_found(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    moved = tmp_path / "deep" / "moved.py"
    plain = tmp_path / "plain.py"
    moved.write_text('"""Doc."""\n@compiled("void()")\ndef f(): ...\n')
    plain.write_text("def compiled(): ...\n")
    assert compiled_sources(tmp_path)[1:] == [moved]


def test_nothing_else_compiles_in_the_package() -> None:
    plain = [each for each in PACKAGE.rglob("*.py") if "njit" in each.read_text("utf-8")]
    assert plain == [PACKAGE / "_numba.py"]


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(monkeypatch, capsys) -> None:
    def no_folder(self) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(Dispatcher, "enable_caching", no_folder)
    _say.cache_clear()
    for _ in range(2):
        assert compiled("float64(float64)")(lambda x: x + 1.0)(1.0) == 2.0
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "sb3-yann compiles its inner loops (at each start, for its folder takes no file): about a "
        "minute in all."
    ]
    _say.cache_clear()
