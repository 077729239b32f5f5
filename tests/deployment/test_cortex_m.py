"""On an emulated microcontroller the reactor's policy is the controller, and small."""

from __future__ import annotations

import pytest

from benchmarks.cortex_m import emulate, missing
from deployed import policy_of

pytestmark = pytest.mark.skipif(bool(missing()), reason=f"no {', '.join(missing())}")


@pytest.mark.parametrize(("name", "flash"), [("reactor", 32_000), ("reactor, shared", 32_000)])
def test_in_single_precision_it_fits_32_kb(name, flash, tmp_path):
    found = emulate(policy_of(name), tmp_path)
    assert found.wrong == 0
    assert found.flash < flash and found.memory < 2_000
    assert 0 < found.mean <= found.worst


def test_a_wrong_answer_is_seen(tmp_path, monkeypatch):
    from benchmarks import cortex_m

    kept = cortex_m.table

    def broken(kind, name, values, precision):
        off = values + 1 if name == "answers" else values
        return kept(kind, name, off, precision)

    monkeypatch.setattr(cortex_m, "table", broken)
    assert emulate(policy_of("reactor"), tmp_path).wrong > 100
