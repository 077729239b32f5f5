"""The page of messages lists those that the code has, of the classes that it names."""

from __future__ import annotations

import runpy
from pathlib import Path

CATALOGUE = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "messages.py"))
MESSAGES = CATALOGUE["messages"]()
OF_PYTHON = {"AttributeError", "FileNotFoundError", "IsADirectoryError", "ImportError", "OSError"}
OWN = {
    "CostMismatchError",
    "ExplicitLimitError",
    "ExplicitSolutionError",
    "OtherProblemError",
    "UntrustedTwinError",
}


def test_the_page_lists_the_messages_of_the_code():
    page = CATALOGUE["PAGE"].read_text(encoding="utf-8")
    assert CATALOGUE["page"](MESSAGES) in page, "run python docs/messages.py"


def test_wrong_values_and_types_are_value_and_type_errors():
    kinds = {each.kind for each in MESSAGES if each.kind.endswith("Error")}
    # The last one is part of a ValueError's message, a plant's state that is none an error of it.
    rare = {"RuntimeError", "FloatingPointError", "NotSmoothError"}
    assert kinds - OF_PYTHON - OWN - rare == {"ValueError", "TypeError"}
