"""The guard's plants pay another reward than the MPC's cost, of which its audit warns."""

from pathlib import Path

import pytest

IGNORED = pytest.mark.filterwarnings("ignore:The reward is not minus the cost")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the guard's tests pass over it; those of the audit itself ask for the warning."""
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(IGNORED)
