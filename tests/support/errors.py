"""What an error says, in tables of bad arguments."""

from typing import Any

import pytest

Message = str | TypeError
"""A message is a ValueError's, unless it says that it is a TypeError's."""


def raises(expected: Message) -> Any:
    """Return a context in which this error must be raised."""
    kind = ValueError if isinstance(expected, str) else TypeError
    return pytest.raises(kind, match=str(expected))
