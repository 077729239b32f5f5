"""Write the files of a controller, in the format that the path names."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

from sb3_yann._archive import atomic_write, digest_of, write_arrays
from sb3_yann._validation import check_choice, check_options, check_type
from sb3_yann.deployment.c_code import c_files, fmu_file, known_answers
from sb3_yann.deployment.code import Cost
from sb3_yann.deployment.describe import Checks, Estimator, Exportable, describe
from sb3_yann.deployment.onnx_graph import onnx_model
from sb3_yann.deployment.structured_text import RESERVED, plcopen_xml, st_text


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
    218
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
    checks: Checks | None = None,
    estimator: Estimator = None,
) -> Exported:
    """Write a controller that runs without this package, as a file or as code.

    It is what `model.predict` is, law, networks, bounds and all, in the precision asked for; and a
    step that checks the readings and falls back, see :class:`Controller`.

    Parameters
    ----------
    given : model, YannPolicy, LinearMPC or PiecewiseAffine
        Where a model has learnt what neither a guard nor `improve` has confirmed, every file says
        so. An MPC and a law take theta and put out the input, in plant units where the model has an
        operating point.
    path : str or PathLike
        Its suffix is the format.
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
    checks : Checks, optional
        Limits of the readings and how to fall back. By default only what is not finite is a fault,
        and late steps where the time is passed.
    estimator : StateEstimator or "caller", optional
        What estimates states and disturbances from measured outputs. It becomes part of the
        controller, which then takes the outputs y, references r, measured disturbances, and puts
        out the input: ``controller([*y, *r, *d])``. "caller" leaves it to your code, and every file
        says so. A problem with estimated states or disturbances is refused without.

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
    wanted = 'the path of a file, after what goes into it: export(model, "controller.c")'
    target = Path(check_type("path", path, str | PathLike, wanted))
    kind = format or target.suffix.lstrip(".")
    check_choice("format", kind, ("npz", "c", "onnx", "st", "xml", "fmu"))
    check_choice("precision", precision, ("double", "float"))
    prefix = target.stem if name is None else name
    if not isinstance(prefix, str) or not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", prefix):
        raise ValueError(
            f"name = {prefix!r} must be a word of letters, digits and underscores that begins with "
            "a letter: it goes into the names of the code. Pass another name."
        )
    if not target.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {target.parent}: make it first.")
    if kind in ("st", "xml") and RESERVED.fullmatch(prefix):
        raise ValueError(
            f"name = {prefix!r} is a word of Structured Text, or no name in it. Pass another name."
        )
    if kind == "c" and target.stem.lower() in ("math", "stddef", "stdint", "stdio"):
        raise ValueError(
            f"{target.stem}.h would stand in for C's own header: call the file something else."
        )
    limits = check_options("checks", Checks() if checks is None else checks, Checks)
    data = describe(given, prefix, limits, estimator)
    if kind == "onnx" and "est_gain" in data:
        raise ValueError(
            "An ONNX graph has no memory, so it holds no estimator: take another format, or pass "
            'estimator="caller".'
        )
    if "qp_gram" in data and (kind in ("onnx", "st", "xml") or precision != "double"):
        raise ValueError(
            "The law is solved online, by a quadratic program at each step. That is exported as "
            f"C, FMU or npz in double, not as {kind} in {precision}: or solve problem.explicit() "
            "without a limit before the model is made, or shorten the horizon."
        )
    digest = digest_of(data)[:12]
    note = str(data["note"])
    about = (
        f"{prefix}, a controller, written by sb3-yann {version('sb3-yann')}; digest {digest}."
        + f"\nNOTE: {note}" * bool(note)
    )
    files: dict[Path, str | bytes] = {}
    if kind == "npz":
        write_arrays(target, data)
    elif kind == "c":
        texts = c_files(data, precision, about, target.stem)
        files = {target.parent / file: text for file, text in texts.items()}
    elif kind == "onnx":
        files = {target: onnx_model(data, precision, digest)}
    else:
        if kind in ("st", "xml") and precision == "float":
            known_answers(data, precision)  # an error where roundings of readings move the output
        write: Any = {"st": st_text, "xml": plcopen_xml, "fmu": fmu_file}[kind]
        files = {target: write(data, precision, about)}
    with ExitStack() as stack:  # all of them, or none
        parts = [stack.enter_context(atomic_write(each)) for each in files]
        for part, content in zip(parts, files.values(), strict=True):
            part.write_bytes(content if isinstance(content, bytes) else content.encode("ascii"))
    paths = tuple(files or [target])
    sizes = tuple(each.stat().st_size for each in paths)
    return Exported(paths, sizes, Cost.of(data), digest, note)
