"""Twins here are of polynomials, where a test asks for nothing else: networks take seconds."""

import pytest

from sb3_yann.twin import plant_twin


@pytest.fixture(autouse=True)
def no_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no log be long enough for them."""
    monkeypatch.setattr(plant_twin, "LONG_LOG", 10**9)
