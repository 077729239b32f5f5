"""Solving needs no licence, prints nothing, and leaves the process as it was."""

from __future__ import annotations

import pickle
import random
from pathlib import Path

import numpy as np
import pytest

from fresh_process import run_python
from sample_problems import benchmark
from sb3_yann.control import ExplicitLimitError

NOT_INSTALLED = """
import sys
for name in ("gurobipy", "quadprog", "cvxopt"):
    sys.modules[name] = None
from sb3_yann_envs import problems
problems.cstr().explicit()
sys.exit(problems.cstr().explicit("ppopt").n_regions)
"""

FROZEN_LAW = """
import sys, pickle
for name in ("ppopt", "daqp", "cvxopt", "gurobipy"):
    sys.modules[name] = None
mpc = pickle.load(sys.stdin.buffer)
mpc.explicit()([0.0, 0.0])
sys.exit(mpc.explicit().n_regions)
"""


@pytest.mark.slow
def test_solving_needs_no_other_solver_and_prints_nothing() -> None:
    done = run_python(NOT_INSTALLED)
    assert (done.returncode, done.stdout, done.stderr) == (7, b"", b"")


def test_ppopt_is_left_as_it_was() -> None:
    from ppopt import solver
    from ppopt.solver_interface import solver_interface as inner

    shipped = solver.solve_lp_cvxopt, inner.solve_lp_cvxopt
    with pytest.raises(ExplicitLimitError):
        benchmark().explicit("ppopt", time_limit=1e-6)
    assert benchmark().explicit("ppopt").n_regions == 9
    assert (solver.solve_lp_cvxopt, inner.solve_lp_cvxopt) == shipped


@pytest.mark.slow
def test_a_solved_problem_needs_no_solver() -> None:
    mpc = benchmark()
    mpc.explicit()
    done = run_python(FROZEN_LAW, stdin=pickle.dumps(mpc))
    assert (done.returncode, done.stdout, done.stderr) == (9, b"", b"")


def test_random_state_settings_of_numpy_and_the_folder_are_untouched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    python, legacy = random.getstate(), np.random.get_state(legacy=False)  # noqa: NPY002
    settings = np.geterr(), np.get_printoptions()
    benchmark().explicit()
    assert random.getstate() == python
    np.testing.assert_equal(np.random.get_state(legacy=False), legacy)  # noqa: NPY002
    assert (np.geterr(), np.get_printoptions()) == settings
    assert list(tmp_path.iterdir()) == []
