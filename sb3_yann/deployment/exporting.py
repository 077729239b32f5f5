"""Write the files of a controller, in the format that the path names."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from os import PathLike
from pathlib import Path

from sb3_yann import _archive
from sb3_yann._validation import check_bool, check_choice, check_options
from sb3_yann.deployment.c_code import c_files
from sb3_yann.deployment.checks import Checks
from sb3_yann.deployment.cost import Cost, cost_of
from sb3_yann.deployment.describe import NO_ONE, Arrays, Exportable, describe
from sb3_yann.deployment.fmu import fmu_file
from sb3_yann.deployment.onnx_graph import onnx_model
from sb3_yann.deployment.rounding import PRECISIONS
from sb3_yann.deployment.structured_text import RESERVED, plcopen_xml, st_text

C_HEADERS = ("math", "stddef", "stdint", "stdio")  # which the code includes
WORDS = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Attributes
    ----------
    paths : tuple of Path
    sizes : tuple of int
        Bytes of each file.
    cost : Cost
        Tables, and the operations of a step at worst.
    digest : str
        Of the arrays: two exports of the same controller have the same.
    note : str
        What the controller lacks; empty where nothing.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> export(problems.cstr().explicit(), "reactor.npz").cost.multiplications
    694
    """

    paths: tuple[Path, ...]
    sizes: tuple[int, ...]
    cost: Cost
    digest: str
    note: str = ""

    def __str__(self) -> str:
        """Say it in words."""
        pairs = zip(self.paths, self.sizes, strict=True)
        written = ", ".join(f"{path} ({size / 1000:.1f} kB)" for path, size in pairs)
        lacks = f". NOTE: {self.note}" if self.note else ""
        return f"{written}; {self.cost}; digest {self.digest}{lacks}"


def export(
    given: Exportable,
    path: str | PathLike[str],
    *,
    format: str | None = None,
    name: str | None = None,
    precision: str = "double",
    absolute: bool = False,
    checks: Checks | None = None,
    observer: str = NO_ONE,
) -> Exported:
    """Write a controller that runs without this package, as a file or as code.

    It is what `model.predict` is, law, networks, bounds and all, in the precision asked for; and a
    step that checks the readings and falls back, see :class:`Controller`.

    Parameters
    ----------
    given : model, YannPolicy, LinearMPC or PiecewiseAffine
        An MPC and a law take theta and put out the input in deviations. A law alone does not know
        the `RateLimits` of its problem: pass the problem, and they are kept.
    path : str or PathLike
        Its suffix tells the format.
    format : {"npz", "c", "onnx", "st", "xml", "fmu"}, optional
        ``npz`` is for :class:`Controller`, which needs numpy alone. ``c`` is C99: a file, its
        header beside it, and a test with known answers. ``onnx`` is a graph without memory, from
        ``obs`` (batch, n_obs) to ``action`` and ``outside``; it needs onnx to write. ``st`` is
        IEC 61131-3 Structured Text, a function block; ``xml`` the same for PLCopen's importers.
        ``fmu`` is an FMU for co-simulation, FMI 2.0: sources, and a library where a C compiler is.
    name : str, optional
        Prefix of all names in code; the file's by default.
    precision : {"double", "float"}, default "double"
        Of the numbers in code and graphs.
    absolute : bool, default False
        Whether observations are theta, and actions inputs, as the plant has them. By default they
        are the env's, or the law's.
    checks : Checks, optional
        Limits of the readings and how to fall back. By default only what is not finite is a fault,
        and late steps where the time is told.
    observer : {"none", "caller"}, default "none"
        Who runs the observer of estimated disturbances, as of :func:`offset_free`: an export holds
        none, and is refused for such a problem unless the caller does. Every file says so then.

    Returns
    -------
    Exported
        What was written, and what a step costs; print it.

    Raises
    ------
    ImportError, OSError, TypeError, ValueError
        If there is no such export; nothing is written then.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> written = export(problems.cstr().explicit(), "reactor.c", precision="float")
    >>> [path.name for path in written.paths]
    ['reactor.c', 'reactor.h', 'reactor_selftest.c']
    """
    target = Path(path)
    kind = check_choice("format", format or target.suffix.lstrip("."), tuple(FORMATS))
    check_choice("precision", precision, PRECISIONS)
    called = target.stem if name is None else name
    if not isinstance(called, str) or not WORDS.fullmatch(called):
        raise ValueError(
            f"name = {called!r} must be a word of letters, digits and underscores that begins with "
            "a letter: it goes into the names of the code. Pass another name."
        )
    if not target.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {target.parent}: make it first.")
    if kind in ("st", "xml") and called.upper() in RESERVED:
        raise ValueError(f"name = {called!r} is a word of Structured Text. Pass another name.")
    own = check_options("checks", checks or Checks(), Checks)
    data = describe(given, called, own, check_bool("absolute", absolute), observer)
    paths = FORMATS[kind](data, target, precision)
    sizes = tuple(each.stat().st_size for each in paths)
    return Exported(tuple(paths), sizes, cost_of(data), digest_of(data), str(data["note"]))


def digest_of(data: Arrays) -> str:
    """Return twelve characters that tell one controller from another: its file's begin so."""
    return _archive.digest_of(data)[:12]


def _write_npz(data: Arrays, path: Path, precision: str) -> list[Path]:
    _archive.write_arrays(path, data)
    return [path]


def _write_c(data: Arrays, path: Path, precision: str) -> list[Path]:
    if path.stem.lower() in C_HEADERS:
        raise ValueError(
            f"{path.stem}.h would stand in for C's own header: call the file something else."
        )
    texts = c_files(data, precision, _about(data), path.stem)
    parts = {path.parent / file: text for file, text in texts.items()}
    return write_texts(parts)


def _write_onnx(data: Arrays, path: Path, precision: str) -> list[Path]:
    return write_texts({path: onnx_model(data, precision, digest_of(data))})


def _write_st(data: Arrays, path: Path, precision: str) -> list[Path]:
    return write_texts({path: st_text(data, precision, _about(data))})


def _write_plcopen(data: Arrays, path: Path, precision: str) -> list[Path]:
    return write_texts({path: plcopen_xml(data, precision, _about(data))})


def _write_fmu(data: Arrays, path: Path, precision: str) -> list[Path]:
    return write_texts({path: fmu_file(data, precision, _about(data))})


def _about(data: Arrays) -> str:
    said = (
        f"{data['name']}, a controller, written by sb3-yann {version('sb3-yann')}; "
        f"digest {digest_of(data)}."
    )
    return f"{said}\nNOTE: {data['note']}" if data["note"] else said


def write_texts(texts: Mapping[Path, str | bytes]) -> list[Path]:
    """Write all files, or none; return their paths."""
    parts = {path: path.with_name(f"{path.name}.{os.getpid()}.part") for path in texts}
    try:
        for path, text in texts.items():
            content = text if isinstance(text, bytes) else text.encode("ascii")
            parts[path].write_bytes(content)
        for path, part in parts.items():
            os.replace(part, path)
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
    return list(texts)


FORMATS: dict[str, Callable[[Arrays, Path, str], list[Path]]] = {
    "npz": _write_npz,
    "c": _write_c,
    "onnx": _write_onnx,
    "st": _write_st,
    "xml": _write_plcopen,
    "fmu": _write_fmu,
}
