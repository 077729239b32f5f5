"""The guard's plants pay another reward than the MPC's cost, and one ignores its input."""

from pathlib import Path

import pytest

IGNORED = pytest.mark.filterwarnings(
    "ignore:The reward is not minus the cost", r"ignore:u\[0\] moves the env otherwise.* 0 times"
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the guard's tests pass over it; those of the audit itself ask for the warning."""
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(IGNORED)
