"""Runs the subset of Structured Text that an export writes, as Python."""

import math
import re
from typing import Any

WORDS = {"and": "and", "or": "or", "not": "not", "true": "True", "false": "False", "mod": "%"}
BLOCKS = {
    r"for (\w+) := (.+) to (.+) do": r"for \1 in range(int(\2), int(\3) + 1):",
    r"while (.+) do": r"while \1:",
    r"if (.+) then": r"if \1:",
    r"elsif (.+) then": r"elif \1:",
    r"else": r"else:",
}


def _exp(x: float) -> float:
    return math.exp(x) if x < 700 else math.inf


FUNCTIONS = {
    "abs": abs,
    "min": min,
    "max": max,
    "exp": _exp,
    "dint_to_lreal": float,
    "dint_to_real": float,
}


class FunctionBlock:
    """A function block with its variables; a call of :meth:`step` is one of the block."""

    def __init__(self, text: str) -> None:
        plain = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S).lower()
        declared, body = plain.rsplit("end_var", 1)
        self.vars: dict[str, Any] = dict(FUNCTIONS)
        for name, kind, value in re.findall(r"(\w+) : ([^;]+?)(?: := ([^;]+))?;", declared):
            self.vars[name] = _initial(kind, value)
        # A line with nothing but a part of a statement goes on: there is none.
        self.code = compile(_python(body), "function block", "exec")

    def step(self, **inputs: Any) -> tuple[list[float], int, int]:
        """Return command, status and mode."""
        self.vars.update(inputs)
        exec(self.code, self.vars)
        return list(self.vars["command"]), self.vars["status"], self.vars["mode"]


def _initial(kind: str, value: str) -> Any:
    if not kind.startswith("array"):
        if kind == "bool":
            return value == "true"
        return int(value or 0) if kind == "dint" else float(value or 0)
    low, high, base = re.fullmatch(r"array\[(\d+)\.\.(\d+)\] of (\w+)", kind).groups()
    number = int if base == "dint" else float
    size = int(high) - int(low) + 1
    if not value:
        return [number(0)] * size
    found: list[Any] = []
    for entry in value.strip("[] \n").split(","):
        repeated = re.fullmatch(r"\s*(\d+)\((.*)\)\s*", entry)
        count, text = (int(repeated[1]), repeated[2]) if repeated else (1, entry)
        found += [number(text)] * count
    assert len(found) == size, f"{len(found)} values for {size} entries"
    return found


def _python(body: str) -> str:
    lines = []
    depth = 0
    for line in (each.strip() for each in body.splitlines()):
        if not line or line.startswith("end_function_block"):
            continue
        if line.startswith("end_"):
            depth -= 1
            continue
        for pattern, block in BLOCKS.items():
            if re.fullmatch(pattern, line):
                if line.startswith(("elsif", "else")):
                    depth -= 1
                lines.append("    " * depth + _expression(re.sub(pattern, block, line)))
                depth += 1
                break
        else:
            name, is_assigned, value = line.rstrip(";").partition(" := ")
            assert is_assigned and line.endswith(";"), f"no statement: {line}"
            lines.append("    " * depth + f"{name} = {_expression(value)}")
    assert depth == 0
    return "\n".join(lines)


def _expression(text: str) -> str:
    text = re.sub(r"(?<![<>:=])=(?!=)", "==", text).replace("<>", "!=")
    text = re.sub(r"(\w+) / (\d+)(?![\d.])", r"\1 // \2", text)  # of whole numbers
    return re.sub(r"\b(and|or|not|true|false|mod)\b", lambda word: WORDS[word[1]], text)
