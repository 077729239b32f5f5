"""What an error says, in tables of bad arguments, and what warnings say."""

import warnings
from collections.abc import Callable
from typing import Any

import pytest

Message = str | TypeError
"""A message is a ValueError's, unless it says that it is a TypeError's."""


def raises(expected: Message) -> Any:
    """Return a context in which this error must be raised."""
    kind = ValueError if isinstance(expected, str) else TypeError
    return pytest.raises(kind, match=str(expected))


def told(run: Callable[[], Any], kind: type[Warning] = Warning) -> list[str]:
    """Return the warnings of a kind that a function gives, all of them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run()
    return [str(each.message) for each in caught if issubclass(each.category, kind)]
