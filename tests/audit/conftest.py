"""What `headroom` and `improve` say of an env does not depend on how long they fit models."""

import pytest

from improvement_samples import quick


@pytest.fixture(autouse=True)
def brisk(monkeypatch) -> None:
    quick(monkeypatch)
