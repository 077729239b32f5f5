"""Files of arrays: what was written comes back to the bit, all else is refused in little memory."""

import contextlib
import io
import os
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from sb3_yann import _archive
from sb3_yann._archive import digest_of, read_arrays, write_arrays

ARRAYS = {
    "gains": np.arange(6.0).reshape(2, 3), "by columns": np.asfortranarray(np.eye(3)[:, 1:]),
    "count": np.int64(3), "flag": np.bool_(True), "name": "Tank Ä",
    "names": np.array(["x", "level"]), "none": np.empty((0, 40)),
    "some": np.float32([np.nan, -0.0]),
}  # fmt: skip


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_arrays(tmp_path / "one.npz", ARRAYS)
    return tmp_path / "one.npz"


def test_arrays_come_back_to_the_bit(path: Path) -> None:
    found = read_arrays(path)
    assert found.keys() == ARRAYS.keys()
    for name, each in ARRAYS.items():
        array = np.asarray(each)
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        assert found[name].tobytes() == array.tobytes()
        assert found[name].flags.f_contiguous == array.flags.f_contiguous


@pytest.mark.nightly
def test_every_flipped_bit_is_refused_or_changes_nothing(path: Path) -> None:
    content = path.read_bytes()
    refused = 0
    for at in range(len(content)):
        broken = bytearray(content)
        broken[at] ^= 1 << at % 8
        path.write_bytes(broken)
        try:
            assert digest_of(read_arrays(path)) == digest_of(ARRAYS)
        except ValueError:
            refused += 1
    assert refused > 0.6 * len(content)  # the rest are dates and other words of the zip


def entry(header: str, content: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


def claim(kind: str, shape: str) -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"


def archive(entries: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    found = io.BytesIO()
    with zipfile.ZipFile(found, "w", compression) as file:
        for name, content in entries:
            file.writestr(name, content)
    return found.getvalue()


def overlapping() -> bytes:
    """Return an archive whose thousand entries are one and the same megabyte."""
    whole = archive([("a.npy", entry(claim("<f8", "(131072,)"), bytes(2**20)))])
    start = whole.index(b"PK\x01\x02")
    listed = whole[start : whole.index(b"PK\x05\x06")]
    tail = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, 999, 999, 999 * len(listed), start, 0)
    return whole[:start] + 999 * listed + tail


HOSTILE = {
    "a bomb": lambda: archive([("a.npy", bytes(10**8))], zipfile.ZIP_DEFLATED),
    "overlapping entries": overlapping,
    "terabytes in a header": lambda: archive([("a.npy", entry(claim("<f8", "(1000000000000,)")))]),
    "no bytes, many columns": lambda: archive([("a.npy", entry(claim("<f8", "(0, 10000000000)")))]),
    "letters of no size": lambda: archive([("a.npy", entry(claim("<U0", "(10000000000,)")))]),
    "a letter of terabytes": lambda: archive([("a.npy", entry(claim("<U999999999", "()")))]),
    "too little": lambda: archive([("a.npy", entry(claim("<f8", "(2,)"), bytes(8)))]),
    "too much": lambda: archive([("a.npy", entry(claim("<f8", "(2,)"), bytes(24)))]),
    "objects": lambda: archive([("a.npy", entry(claim("|O", "()"), b"\x80\x04N."))]),
    "code": lambda: archive([("a.npy", entry("{'descr': __import__('os').getcwd(), }"))]),
    "half a float": lambda: archive([("a.npy", entry(claim("<f3", "()"), bytes(3)))]),
    "a file beside": lambda: archive([("../readme.txt", b"hello")]),
    "nothing": lambda: archive([]),
    "a digest alone": lambda: archive([("digest.npy", entry(claim("<U1", "()"), b"a\0\0\0"))]),
    "two of one name": lambda: archive([("a.npy", entry(claim("<i8", "()"), bytes(8)))] * 2),
    "no digest": lambda: archive([("a.npy", entry(claim("<i8", "()"), bytes(8)))]),
    "nested brackets": lambda: archive([("a.npy", entry("{'descr': " + 90 * "("))]),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_in_little_memory(kind: str, tmp_path: Path) -> None:
    content = HOSTILE[kind]()
    (tmp_path / "law.npz").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError):
            read_arrays(tmp_path / "law.npz")
        assert tracemalloc.get_traced_memory()[1] < 4 * len(content) + 10**6
    finally:
        tracemalloc.stop()


def test_other_numbers_under_the_old_digest_are_refused(path: Path) -> None:
    with np.load(path) as data:
        arrays = dict(data)
    np.savez(path, **{**arrays, "count": 4})
    with pytest.raises(ValueError, match="changed since it was written"):
        read_arrays(path)


def test_files_that_are_too_large_are_neither_written_nor_read(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_archive, "MAX_SIZE", 100)
    with pytest.raises(ValueError, match="100 are not read"):
        read_arrays(path)
    with pytest.raises(ValueError, match="100 are not read"):
        write_arrays(path, ARRAYS)


def test_a_folder_and_a_file_that_is_missing_are_os_errors(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.npz"):
        with pytest.raises(OSError):
            read_arrays(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_a_pipe_is_refused_and_does_not_wait(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "law.npz")
    with pytest.raises(ValueError, match="pipe"):
        read_arrays(tmp_path / "law.npz")


def test_a_file_that_fails_to_be_written_leaves_the_old_one_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "file.txt"
    for text, error in (("old", None), ("new", RuntimeError)):
        with contextlib.suppress(RuntimeError), _archive.atomic_write(path) as part:
            part.write_text(text)
            if error:
                raise error
    assert path.read_text() == "old" and [*tmp_path.iterdir()] == [path]
