"""Write docs/messages.md: the messages of all errors and warnings, as the source has them.

python docs/messages.py
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "messages.md"
BEGIN, END = "<!-- messages: begin -->", "<!-- messages: end -->"
PACKAGES = ("sb3_yann", "envs/sb3_yann_envs")


@dataclass(frozen=True, order=True)
class Message:
    """An error or a warning: where it is, its class, and its text with … for what is put in."""

    room: str
    text: str
    kind: str
    file: str
    line: int


def messages() -> list[Message]:
    """Return all messages that are written down where they are raised."""
    files = [each for part in PACKAGES for each in (ROOT / part).rglob("*.py")]
    found = [each for file in files for each in _of_file(file)]
    return sorted(each for each in found if len(each.text.strip("… ")) > 3)


def _of_file(file: Path) -> Iterator[Message]:
    path = file.relative_to(ROOT)
    room = path.parts[1].removesuffix(".py")
    room = {"_validation": "any argument", "_archive": "any file"}.get(room, room)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        call = node.exc if isinstance(node, ast.Raise) else node
        if not isinstance(call, ast.Call) or not call.args:
            continue
        kind = ast.unparse(call.func)
        if kind == "warnings.warn":
            given = [ast.unparse(each) for each in call.args[1:2]]
            kind = given[0] if given and given[0].endswith("Warning") else "UserWarning"
        elif not isinstance(node, ast.Raise):
            continue
        yield Message(room, _text(call.args[0]), kind, str(path), node.lineno)


def _text(node: ast.expr) -> str:
    """Return a text as it is printed, with … for each value."""
    if isinstance(node, ast.Constant):
        return " ".join(str(node.value).split())
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
        return " ".join("".join(map(str, parts)).split())
    if isinstance(node, ast.BinOp):
        return f"{_text(node.left)}{_text(node.right)}"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return _text(node.func.value)  # f"...".rstrip()
    return "…"


def page(found: list[Message]) -> str:
    """Return the lists of the page, a room at a time."""
    lines: list[str] = []
    for room in dict.fromkeys(each.room for each in found):
        lines += ["", f"## {room.replace('_', ' ').strip().capitalize()}", ""]
        here = {(each.text, each.kind): None for each in found if each.room == room}
        lines += [f"- {kind}: `{text.replace('`', chr(39))}`" for text, kind in here]
    return "\n".join([*lines, ""])


def main() -> None:
    """Write the page."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    found = messages()
    PAGE.write_text(f"{before}{BEGIN}\n{page(found)}\n{END}{after}", encoding="utf-8")
    print(f"{PAGE.name}: {len(found)} messages")


if __name__ == "__main__":
    main()
