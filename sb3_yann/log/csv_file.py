"""A CSV file with a header, as a historian writes it."""

from __future__ import annotations

import csv
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timezone
from io import StringIO
from pathlib import Path

import numpy as np

from sb3_yann._validation import Array, warn

SECONDS = {"s": 1, "min": 60, "h": 3600, "d": 86400}  # in a unit of time


class CsvFile:
    """The rows of a file by the names of its header, with their lines; blank ones are skipped.

    What cannot be read is a ValueError that names file, line and column.
    """

    def __init__(
        self, path: str | os.PathLike[str], delimiter: str, decimal: str, encoding: str
    ) -> None:
        self.path = path
        self.decimal = decimal
        try:
            text = Path(path).read_text(encoding)
        except UnicodeError:
            raise ValueError(
                f"{path} is not in {encoding}: pass encoding='latin-1', 'utf-16' or what it is in."
            ) from None
        reader = csv.DictReader(StringIO(text), delimiter=delimiter)
        self.header = list(reader.fieldnames or [])
        self.rows: list[dict[str, str]] = []
        self.lines: list[int] = []
        for row in reader:
            if reader.restkey in row:
                raise ValueError(
                    f"{path}, line {reader.line_num} has more entries than the header, "
                    f"{self.header}, has names. Leave out lines above the header. Numbers with a "
                    f"decimal comma need another delimiter than {delimiter!r}, and decimal=','."
                )
            self.rows.append(row)
            self.lines.append(reader.line_num)

    def column(self, name: str) -> str:
        """Return the column of this name, with or without its unit."""
        found = [each for each in self.header if name in (each, self.name_and_unit(each)[0])]
        if not found:
            marks = ";,\t" if len(self.header) == 1 else ";"
            other = next((each for each in marks if each in "".join(self.header)), "")
            hint = f" Its delimiter seems to be another: pass delimiter={other!r}." * bool(other)
            hint += " It is empty." * (not self.header)
            raise ValueError(f"{self.path} has no column {name!r}; it has {self.header}.{hint}")
        if len(found) > 1:
            raise ValueError(f"{self.path} has several columns {name!r}: give each its own name.")
        return found[0]

    @staticmethod
    def name_and_unit(header: str) -> tuple[str, str]:
        """Return the name and the unit of a column: ``T [K]`` is T in K."""
        name, bracket, unit = header.strip().removesuffix("]").rpartition(" [")
        return (name.strip(), unit.strip()) if bracket and header.endswith("]") else (header, "")

    def numbers(self, names: Sequence[str]) -> Array:
        """Return columns (rows, names), NaN where a cell is empty or a word."""
        table = np.array([[self._number(k, name) for name in names] for k in range(len(self.rows))])
        if not len(table):
            raise ValueError(f"{self.path} has no rows below its header.")
        for name, column in zip(names, table.T, strict=True):
            cells = ((row[name] or "").strip() for row in self.rows)
            words = Counter(x for x in cells if _is_word(x) and x not in ("", "nan", "NaN"))
            shown = ", ".join(f"{word!r} in {count:,} rows" for word, count in words.most_common(3))
            if words and not np.isfinite(column).any():
                raise ValueError(f"{self.path}: {name} is {shown}, and never a number.")
            if words:
                warn(f"{name} of {self.path} is {shown}: taken for no reading.")
        return table

    def _number(self, k: int, name: str) -> float:
        text = (self.rows[k][name] or "").strip()
        try:
            if (self.decimal != "." and "." in text) or "_" in text:  # Python reads 20_0 as 200
                raise ValueError
            return float(text.replace(self.decimal, ".")) if text else np.nan
        except ValueError:
            if _is_word(text):
                return np.nan
            raise ValueError(
                f"{self.path}, line {self.lines[k]}: {name} is {text!r}, expected a number whose "
                f"decimal sign is {self.decimal!r}: decimal= says which it is. Leave out "
                "thousands' separators, and the cell empty where there is no reading."
            ) from None

    def times(self, name: str, unit: str) -> tuple[Array, str]:
        """Return a column of times (rows,) in a unit, and the unit: without one the header's."""
        own = self.name_and_unit(name)[1]
        words = {"sec": "s", "min": "min", "hour": "h", "hr": "h", "day": "d"}
        own = next((short for word, short in words.items() if own.lower().startswith(word)), own)
        unit = unit or own
        instants, stamped = np.array([self._time(k, name, unit) for k in range(len(self.rows))]).T
        if np.any(stamped):
            return instants, unit or "s"
        if own in SECONDS and unit in SECONDS:
            instants = instants * SECONDS[own] / SECONDS[unit]
        elif own not in ("", unit):
            raise ValueError(
                f"{self.path} has times in {own!r} by its header, and time_unit = {unit!r}: "
                f"expected are {[*SECONDS]}, in both."
            )
        return instants, unit

    def _time(self, k: int, name: str, unit: str) -> tuple[float, bool]:
        """Return a time as it is given, or an ISO 8601 time stamp in the unit; and which it is."""
        with suppress(ValueError):
            number = self._number(k, name)
            if not _is_compact((self.rows[k][name] or "").strip()):
                return number, False
        text = self.rows[k][name]
        try:
            stamp = datetime.fromisoformat(text.strip())
        except ValueError:
            raise ValueError(
                f"{self.path}, line {self.lines[k]}: {name} is {text!r}, expected a number or a "
                "time stamp such as 2026-01-31 08:00. pandas.to_datetime(column, format=...) makes "
                "it."
            ) from None
        if unit not in ("", *SECONDS):
            raise ValueError(
                f"{self.path} has time stamps, and time_unit = {unit!r}: expected one of "
                f"{[*SECONDS]}, that of dt."
            )
        # A stamp with an offset from UTC counts in UTC: local time runs twice at a clock's change.
        epoch = datetime(1970, 1, 1, tzinfo=stamp.tzinfo and timezone.utc)
        passed = (stamp - epoch).total_seconds()
        return passed / SECONDS[unit or "s"], True


def _is_compact(text: str) -> bool:
    """Return whether a number is a time stamp as 20260131080000, or without its seconds."""
    form = {12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}.get(len(text))
    with suppress(ValueError):
        return form is not None and 1900 < datetime.strptime(text, form).year < 2100
    return False


def _is_word(text: str) -> bool:
    """Return whether a cell is no number, as "Bad Input", "Bad (0x80)", "#DIV/0!" and "---"."""
    return text[:1].isalpha() or text[:1] == "#" or not any(map(str.isdigit, text))
