"""Twins here are of polynomials, and improvements short: every batch makes both."""

import pytest

from improvement_samples import quickest
from sb3_yann.twin import plant_twin


@pytest.fixture(autouse=True)
def no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no log be long enough for them, but where a test asks for nothing else."""
    monkeypatch.setattr(plant_twin, "LONG_LOG", 10**9)
    quickest(monkeypatch)
