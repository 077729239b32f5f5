"""Twins here are of polynomials, and improvements short: every batch makes both."""

import pytest

from improvement_samples import quickest


@pytest.fixture(autouse=True)
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    quickest(monkeypatch)
