"""Checks of user input that name the value, what was expected and what to do."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar
from unicodedata import category

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Given = ArrayLike | None
Bounds = tuple[Array, Array]  # low, high
Feedback = Callable[[Array], Array]  # thetas (batch, n_theta) -> inputs (batch, m)
Options = TypeVar("Options")
Kind = TypeVar("Kind")
LARGEST_BOUND = 1e100  # squares and sums of larger ones overflow


class NonFiniteWarning(RuntimeWarning):
    """An observation, a reward, an action or a gradient is not a finite number."""


NOT_THE_USERS = frozenset(
    "sb3_yann sb3_yann_envs stable_baselines3 sb3_contrib gymnasium torch numpy joblib dataclasses "
    "contextlib functools".split()
)
"""A warning is about none of their lines, but about the one that called them."""


def warn(words: str, kind: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user's that led here, however deep this is called."""
    frame = sys._getframe(1)
    level = 2
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in NOT_THE_USERS:
        frame = frame.f_back
        level += 1
    warnings.warn(words, kind, stacklevel=level)


def add_note(error: BaseException, words: str) -> None:
    """Let an error say more; before Python 3.11, which has notes, as one of its arguments."""
    if sys.version_info >= (3, 11):
        error.add_note(words)
    else:
        error.args = (*error.args, words)


def message_of(error: BaseException) -> str:
    """Return an error's message with its notes."""
    return str(error) + "".join(f" ({each})" for each in getattr(error, "__notes__", []))


def check_array(name: str, value: ArrayLike, shape: Sequence[int | str]) -> Array:
    """Return ``value`` as a finite, read-only float64 array of ``shape``; a letter is any size."""
    array = to_float(name, value)
    if array.ndim != len(shape) or any(
        isinstance(want, int) and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        wanted = ", ".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]},"
        hint = " Write a matrix as rows, [[...], [...]], or np.diag([...])."
        hint *= array.ndim < len(shape) == 2
        if name == "Q" and array.ndim == 2:
            hint = " It weighs states: for a weight Q of outputs y = C x, pass C.T @ Q @ C."
        raise ValueError(f"{name} has shape {array.shape}, expected ({wanted}).{hint}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds NaN or infinite entries: {array.tolist()}.")
    return frozen(array)


def check_vector(name: str, value: ArrayLike | None, size: int) -> Array:
    """Return ``value`` as a finite array of shape ``(size,)``, zeros for None."""
    return check_array(name, np.zeros(size) if value is None else value, (size,))


def check_symmetric(name: str, value: ArrayLike, size: int) -> Array:
    """Return ``value`` as a symmetric positive semi-definite ``(size, size)`` matrix."""
    matrix = check_array(name, value, (size, size))
    scale = max(float(np.max(np.abs(matrix))), np.finfo(float).tiny)
    if np.max(np.abs(matrix - matrix.T)) > 1e-9 * scale:
        raise ValueError(
            f"{name} is not symmetric: {matrix.tolist()}. Pass ({name} + {name}.T) / 2."
        )
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -1e-9 * scale:
        raise ValueError(
            f"{name} must be positive semi-definite, its smallest eigenvalue is {smallest:g}."
        )
    return frozen((matrix + matrix.T) / 2)


def check_bounds(
    name: str, lower: ArrayLike | None, upper: ArrayLike | None, size: int, equal: bool = False
) -> tuple[Array, Array]:
    """Return bounds of shape ``(size,)``, the lower below the upper, or ``equal``.

    A scalar is for all entries; None and infinity are no bound. A finite one has at most 1e100.
    """
    below, above = sides_of(name)
    low = _bound(below, lower, size, -np.inf)
    high = _bound(above, upper, size, np.inf)
    wrong = low > high if equal else low >= high
    if np.any(wrong):
        i = int(np.argmax(wrong))
        given = f"{below} = {low[i]:g} and {above} = {high[i]:g}"
        raise ValueError(f"{below} must lie below {above}, but entry {i} has {given}.")
    return low, high


def sides_of(name: str) -> tuple[str, str]:
    """Return what two bounds are called: x_min and x_max, or low and high after a name's mark."""
    if name.endswith((".", "_")):
        return f"{name}low", f"{name}high"
    return f"{name}_min", f"{name}_max"


def check_positive_vector(name: str, value: ArrayLike, size: int, hint: str = "") -> Array:
    """Return ``value`` as positive numbers of shape ``(size,)``; a scalar is for all entries."""
    array = to_float(name, value)
    array = check_array(name, np.full(size, float(array)) if array.ndim == 0 else array, (size,))
    if np.any(array <= 0):
        raise ValueError(
            f"{name} = {array.tolist()} must be above 0 in each entry. {hint}".rstrip()
        )
    return array


def check_outputs(name: str, value: ArrayLike | Sequence[int], n_states: int) -> Array:
    """Return an output matrix ``(q, n)`` from a matrix or from a list of indices of states."""
    rows = check_output_rows(name, value, n_states - 1)
    return check_array(name, np.eye(n_states)[rows] if rows.ndim == 1 else rows, ("q", n_states))


def check_output_rows(
    name: str, value: ArrayLike | Sequence[int], most: float = np.inf
) -> NDArray[Any]:
    """Return indices of states ``(q,)``, at most ``most``, or an output matrix ``(q, n)``."""
    entries = to_float(name, value)
    if entries.ndim == 0:
        raise ValueError(f"{name} = {value!r} must be a list of indices of states: [{value!r}].")
    if entries.ndim != 1:
        _require_moderate(name, entries, "Take another unit of the outputs.")
        return check_array(name, value, ("q", "n"))
    whole = all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in value)  # type: ignore[union-attr]
    if not whole or np.any(entries < 0) or np.any(entries > most):
        limit = f"from 0 to {most}" if np.isfinite(most) else "from 0 on"
        raise ValueError(
            f"{name} = {np.asarray(value).tolist()} must be indices of states, whole numbers "
            f"{limit}, or an output matrix as a list of rows, [[...], [...]]."
        )
    return entries.astype(int)


def is_text(character: str) -> bool:
    """Return whether a character may stand in a line of XML, HTML and UTF-8.

    None are control characters, halves of surrogate pairs, line ends and noncharacters.
    """
    return category(character) not in ("Cc", "Cs", "Zl", "Zp") and ord(character) & 0xFFFE != 0xFFFE


def check_indices(name: str, value: Iterable[int] | str, size: int) -> tuple[int, ...]:
    """Return different whole numbers below ``size``, in order."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise TypeError(f"{name} = {_short(value)} must be a list of indices, e.g. [0].")
    found = sorted(check_int(name, each, 0) for each in value)
    if len({*found}) < len(found) or (found and found[-1] >= size):
        raise ValueError(f"{name} = {found} must be different indices below {size}.")
    return tuple(found)


def check_number(name: str, value: Any, hint: str = "") -> float:
    """Return ``value`` as a finite float."""
    return check_range(name, value, -np.inf, np.inf, "()", hint)


def check_positive(name: str, value: Any, hint: str = "") -> float:
    """Return ``value`` as a finite float above 0."""
    return check_range(name, value, 0, np.inf, "()", hint)


def check_discount(value: Any) -> float:
    """Return ``value`` as a discount factor in (0, 1]."""
    return check_range("gamma", value, 0, 1, "(]")


def check_range(
    name: str, value: Any, low: float, high: float, ends: str = "[]", hint: str = ""
) -> float:
    """Return ``value`` as a finite float between ``low`` and ``high``, infinite for no limit.

    It is a real number of Python or numpy: bools and strings are a TypeError, what lies beyond a
    ValueError. ``ends`` is round where the limit itself is refused: "[]", "(]", "[)", "()". The
    ``hint`` says what to do: a sentence that ends the message.
    """
    value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, bool) or not isinstance(value, kinds):
        if isinstance(value, str) and value[:1].isdigit():
            hint = f"{hint} In YAML 1e-1 is a string: write 0.1, or 1.0e-1.".lstrip()
        raise TypeError(f"{name} = {_short(value)} must be a number. {hint}".rstrip())
    try:
        number = float(value)
    except OverflowError:
        number = np.inf if value > 0 else -np.inf
    left = number >= low if ends[0] == "[" else number > low
    right = number <= high if ends[1] == "]" else number < high
    if left and right and np.isfinite(number):
        return number
    if high < np.inf:
        kind = "be between {} and {}" if ends == "[]" else f"lie in {ends[0]}{{}}, {{}}{ends[1]}"
        wanted = kind.format(f"{low:g}", f"{high:g}")
    else:
        above = f" {'above' if ends[0] == '(' else 'of at least'} {low:g}" if low > -np.inf else ""
        wanted = f"be a finite number{above}"
    raise ValueError(f"{name} = {_short(value)} must {wanted}. {hint}".rstrip())


def check_int(name: str, value: Any, least: int = 1, hint: str = "") -> int:
    """Return ``value`` as an int of at least ``least``, else raise ValueError; bools are none."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(
            f"{name} = {_short(value)} must be a whole number of at least {least}. {hint}".rstrip()
        )
    if value >= 2**63:
        raise ValueError(f"{name} = {_short(value)} must be below 2**63. {hint}".rstrip())
    return int(value)


def check_bool(name: str, value: Any) -> bool:
    """Return ``value`` as a bool, else raise TypeError: 0 and 1 are none."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} = {_short(value)} must be True or False.")
    return bool(value)


def check_choice(name: str, value: Any, options: Sequence[str]) -> str:
    """Return ``value`` if it is one of the options, else raise ValueError."""
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"{name} = {_short(value)} must be one of {tuple(options)}.")
    return value


def check_path(name: str, value: str | PathLike[str] | None) -> Path | None:
    """Return ``value`` as a path, None for None; ValueError where no file can have that name."""
    if value is None:
        return None
    try:
        os.lstat(Path(value))
    except OSError:  # it is not there yet
        pass
    except ValueError as error:
        raise ValueError(
            f"{name} = {value!r} can be no file of this computer ({error}). Give it a name without "
            "such characters; where the locale lacks them, PYTHONUTF8=1 has them all."
        ) from error
    return Path(value)


def check_type(name: str, value: Kind, kind: Any, wanted: str) -> Kind:
    """Return ``value`` if it is of a class, named by ``wanted``, else raise TypeError."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} = {_short(value)} must be {wanted}.")
    return value


def check_options(name: str, value: Any, kind: type[Options]) -> Options:
    """Return a group of options; a mapping, as YAML gives it, holds some of their names.

    Raise TypeError for anything else, and for other names.
    """
    if isinstance(value, kind):
        return value
    known = [each.name for each in fields(kind)]  # type: ignore[arg-type]
    if not isinstance(value, Mapping):
        wanted = f"of the class {kind.__name__}: {name}={kind.__name__}(...), or a mapping"
        raise TypeError(f"{name} = {_short(value)} must be {wanted}.")
    if unknown := [each for each in value if each not in known]:
        unknown_names = ", ".join(map(repr, unknown))
        raise TypeError(f"{name} has no {unknown_names}. Its options are {', '.join(known)}.")
    return kind(**value)


def to_float(name: str, value: Any) -> Array:
    """Return ``value`` as a new float64 array of any shape; raise TypeError if it is none.

    Masked entries are a ValueError: an array of numbers would show what lies under the mask.
    """
    parts = value if isinstance(value, (list, tuple)) else [value]
    if any(isinstance(each, np.ma.MaskedArray) and np.any(each.mask) for each in parts):
        raise ValueError(
            f"{name} has masked entries, expected are numbers. Leave their rows out: split a log "
            "there into two episodes."
        )
    try:
        if np.iscomplexobj(value):
            raise TypeError("it is complex")
        return np.array(value, dtype=np.float64)
    except RuntimeError as error:  # torch's, and torch is not loaded here
        fault = str(error).rstrip(".")
        raise TypeError(
            f"{name} is not an array of real numbers ({fault}). Detach a tensor that has a "
            f"gradient first: pass {name}.detach()."
        ) from None
    except (OverflowError, TypeError, ValueError) as error:
        fault = f"{name} = {_short(value)} is not an array of real numbers ({error})."
        raise TypeError(fault) from None


def _short(value: Any) -> str:
    """Return the representation of a value, without the middle of a long one."""
    try:
        text = repr(value)
    except ValueError:  # Python writes out no whole number of more than 4300 digits
        text = f"<{type(value).__name__} of too many digits to show>"
    return text if len(text) <= 200 else f"{text[:120]} ... {text[-40:]}"


class ReadOnlyArrays:
    """A frozen dataclass that compares its arrays, and keeps them read-only when unpickled."""

    def _store(self, **values: Any) -> None:
        """Set fields, for a constructor that takes more than it keeps; arrays become read-only."""
        for value in values.values():
            for array in value if isinstance(value, tuple) else (value,):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
        vars(self).update(values)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._store(**state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, type(self)):
            return NotImplemented
        names = [field.name for field in fields(self) if field.compare]  # type: ignore[arg-type]
        return all(_same(getattr(self, name), getattr(other, name)) for name in names)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(np.array_equal(one, other))


def _bound(name: str, value: ArrayLike | None, size: int, missing: float) -> Array:
    if is_kept(value) and np.asarray(value).shape == (size,):
        return np.asarray(value)  # the array itself: dataclasses.replace passes what is stored
    array = to_float(name, missing if value is None else value)
    array = np.full(size, float(array)) if array.ndim == 0 else array
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}, expected ({size},) or a single number.")
    if np.any(np.isnan(array)):
        raise ValueError(f"{name} holds NaN: {array.tolist()}. Use inf for 'no bound'.")
    _require_moderate(name, array, "Use inf for 'no bound'.")
    return frozen(array)


def is_kept(value: Any) -> bool:
    """Tell whether a value is an array as these functions return it: checked, and read-only."""
    kept = type(value) is np.ndarray and value.dtype == np.float64
    return bool(kept and value.base is None and not value.flags.writeable)


def _require_moderate(name: str, array: Array, hint: str) -> None:
    """Raise where a finite entry is so large that squares and sums of such overflow."""
    huge = np.argwhere(np.isfinite(array) & (np.abs(array) > LARGEST_BOUND))
    if len(huge):
        at = tuple(map(int, huge[0]))
        raise ValueError(
            f"{name}{[*at]} = {array[at]:g} must be at most {LARGEST_BOUND:g} in size. {hint}"
        )


def frozen(array: Array) -> Array:
    """Return the array itself, read-only and without -0.0."""
    array[array == 0] = 0.0  # -0.0 equals 0.0 but has other bytes; equal objects share a hash
    array.setflags(write=False)
    return array


def finite_sizes(*sides: Array) -> Array:
    """Return the largest finite size among the sides (k,) of each range, 0 where there is none."""
    sizes = np.abs(sides)
    return np.asarray(np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0))


def half_widths(lower: Array, upper: Array) -> Array:
    """Return half the width of each range, and 1 where it is infinite: a unit to measure in."""
    half = (upper - lower) / 2
    return np.asarray(np.where(np.isfinite(half), half, 1.0))
