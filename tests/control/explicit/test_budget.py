"""The choice of a solver and limits of `LinearMPC.explicit`."""

import time
from typing import Any

import numpy as np
import pytest

from errors import Message, raises
from fresh_process import run_python
from sample_problems import benchmark
from sb3_yann.control import ExplicitLimitError, LinearModel, LinearMPC
from sb3_yann.control.explicit import certificate


@pytest.mark.parametrize("solver", ["walk", "ppopt"])
def test_too_many_regions_are_an_error_that_says_what_to_change(solver: str) -> None:
    message = "more than region_limit = 4 regions: .* were found in .* shorten the horizon"
    with pytest.raises(ExplicitLimitError, match=message) as error:
        benchmark().explicit(solver, region_limit=4)
    assert error.value.n_regions == (5 if solver == "walk" else 9)


@pytest.mark.parametrize("solver", ["walk", "ppopt"])
def test_too_long_a_search_is_an_error_that_says_what_to_change(solver: str) -> None:
    with pytest.raises(ExplicitLimitError, match=r"not solved in time_limit = 1e-06 s: .* horizon"):
        benchmark().explicit(solver, time_limit=1e-6)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"time_limit": 0}, "time_limit = 0 must be .* above 0. It is in seconds"),
        ({"time_limit": "1 h"}, TypeError("time_limit = '1 h' must be a number. It is in seconds")),
        ({"solver": "gurobi"}, r"solver = 'gurobi' must be one of \('walk', 'ppopt'\)"),
        ({"region_limit": 0}, "region_limit = 0 must be a whole number of at least 1"),
    ],
)
def test_bad_limit_is_named(limits: dict[str, Any], message: Message) -> None:
    with raises(message):
        benchmark().explicit(**limits)


def test_a_law_that_is_there_keeps_to_the_limit_of_regions() -> None:
    mpc = benchmark()
    assert mpc.explicit().n_regions == 9
    with pytest.raises(ExplicitLimitError, match="region_limit = 8 regions: 9 regions") as error:
        mpc.explicit(region_limit=8)
    assert error.value.n_regions == 9


def test_the_limit_of_time_holds_for_the_check_too(monkeypatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("sb3_yann.control.explicit.budget.time.monotonic", lambda: clock[0])
    original = certificate.Certificate.check

    def later(*args: Any, **options: Any) -> Any:
        clock[0] = 100.0
        return original(*args, **options)

    monkeypatch.setattr(certificate.Certificate, "check", later)
    with pytest.raises(ExplicitLimitError, match=r"50 s: 9 regions .*and not all were checked"):
        benchmark().explicit(time_limit=50)
    monkeypatch.setattr(certificate.Certificate, "check", original)
    assert benchmark().explicit(time_limit=1000).n_regions == 9


def test_nothing_is_compiled_while_the_clock_runs() -> None:
    # A new machine compiles what is imported first, for longer than many a limit.
    printed, _ = run_python(
        """
import sys
from sb3_yann.control.mpc import linear_mpc

class Timer(linear_mpc.BudgetTimer):
    def __enter__(self):
        self.before = set(sys.modules)
        return super().__enter__()
    def __exit__(self, *error):
        loaded = [sys.modules[name] for name in set(sys.modules) - self.before]
        compiled = [each.__name__ for each in loaded if hasattr(each, "compiled")]
        print("compiled meanwhile:", compiled)
        return super().__exit__(*error)

linear_mpc.BudgetTimer = Timer
from sb3_yann_envs import problems
problems.cstr().law()
"""
    )
    assert printed.strip() == "compiled meanwhile: []"


def large_plant() -> LinearMPC:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(8, 8))
    A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
    model = LinearModel(A, rng.normal(size=(8, 4)), 1.0)
    return LinearMPC(
        model, Q=np.eye(8), R=0.1 * np.eye(4), horizon=70, x_min=-4, x_max=4, u_min=-1, u_max=1
    )


def test_the_limit_of_time_holds_where_a_single_linear_program_takes_seconds() -> None:
    mpc = large_plant()
    benchmark().explicit()  # loads what is compiled
    start = time.process_time()
    with pytest.raises(ExplicitLimitError, match="0 regions were found"):
        mpc.explicit(time_limit=0.7)
    assert time.process_time() - start < 5  # 0.8 s on a machine with nothing else to do


def test_a_law_of_too_much_effort_is_given_up_before_it_is_found() -> None:
    with pytest.raises(ExplicitLimitError, match=r"more effort .* regions were found .* horizon"):
        large_plant()._solved(effort_limit=0.2)
