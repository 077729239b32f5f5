"""Points that are known are not computed again, and come back as they were."""

from __future__ import annotations

import pickle

import numpy as np

from general_problems import solved
from sb3_yann.control.online import KnownPoints


class Counted:
    """Returns two sums of each row, and counts the rows it was asked for."""

    def __init__(self) -> None:
        self.rows = 0

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        self.rows += len(rows)
        return np.column_stack([rows.sum(1), rows[:, 0]])


def test_a_full_table_forgets_and_stays_right() -> None:
    counted, rows = Counted(), np.random.default_rng(0).normal(size=(1000, 2))
    known = KnownPoints(counted, 2, size=64)
    for _ in range(3):
        assert np.array_equal(known(rows), Counted()(rows))
    assert counted.rows > 2000


def test_what_a_law_remembers_does_not_travel() -> None:
    law = solved("servo").online()
    law([[0.1, 0.2, 0.3]])
    assert np.any(law.known._keys) and not np.any(pickle.loads(pickle.dumps(law)).known._keys)
