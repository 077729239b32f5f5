"""A ProblemBox is a Box that hands its problem to whoever asks, wherever it has traveled."""

from __future__ import annotations

import copy
import functools
import pickle
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle
import numpy as np
import pytest

from sb3_yann_envs import ProblemBox

MODULE = "problem_box_targets"


class Problem:
    """A stand-in that can be pickled and compared."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self) -> None:
        raise AssertionError("an object that happens to be callable is not a factory")


@pytest.fixture(autouse=True)
def targets(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.ModuleType]:
    module: Any = types.ModuleType(MODULE)

    def factory() -> Problem:
        module.calls += 1
        return Problem("made")

    for name, value in {
        "calls": 0,
        "ready": Problem("ready"),
        "factory": factory,
        "cached_factory": functools.cache(factory),
        "empty_factory": lambda: None,
    }.items():
        setattr(module, name, value)
    monkeypatch.setitem(sys.modules, MODULE, module)
    yield module


def box(problem: object) -> ProblemBox:
    return ProblemBox(-1.0, 1.0, (2,), problem=problem)


def copied(space: ProblemBox) -> ProblemBox:
    return copy.deepcopy(space)


def pickled(space: ProblemBox) -> ProblemBox:
    arrived: ProblemBox = pickle.loads(pickle.dumps(space))
    return arrived


def cloudpickled(space: ProblemBox) -> ProblemBox:
    arrived: ProblemBox = cloudpickle.loads(cloudpickle.dumps(space))
    return arrived


TRAVELS: list[Callable[[ProblemBox], ProblemBox]] = [copied, pickled, cloudpickled]


def test_an_object_is_returned_as_it_is() -> None:
    problem = Problem("given")
    assert box(problem).problem is problem


@pytest.mark.parametrize("name", ["factory", "cached_factory"])
def test_a_reference_to_a_factory_is_called_once_and_not_before_it_is_needed(
    name: str, targets: Any
) -> None:
    space = box(f"{MODULE}:{name}")
    assert targets.calls == 0
    assert space.problem is space.problem
    assert targets.calls == 1


@pytest.mark.parametrize("travel", TRAVELS)
def test_an_unresolved_reference_survives_the_travel(
    travel: Callable[[ProblemBox], ProblemBox], targets: Any
) -> None:
    arrived = travel(box(f"{MODULE}:factory"))
    assert targets.calls == 0
    assert arrived.problem.name == "made"  # type: ignore[attr-defined]


@pytest.mark.parametrize("travel", TRAVELS)
def test_a_resolved_problem_travels_with_the_space(
    travel: Callable[[ProblemBox], ProblemBox], targets: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = box(f"{MODULE}:factory")
    space.problem.name = "changed after it was made"  # type: ignore[attr-defined]
    monkeypatch.delattr(targets, "factory")
    assert travel(space).problem.name == "changed after it was made"  # type: ignore[attr-defined]


@pytest.mark.parametrize("travel", TRAVELS)
def test_the_bounds_survive_the_travel(travel: Callable[[ProblemBox], ProblemBox]) -> None:
    space = box(Problem("given"))
    arrived = travel(space)
    assert type(arrived) is ProblemBox
    assert arrived == space
    assert arrived.dtype == np.float32


@pytest.mark.parametrize(
    "reference", ["", "module", "module:", ":name", "a b:c", "a:b:c", "a..b:c"]
)
def test_a_malformed_reference_is_refused_at_once(reference: str) -> None:
    with pytest.raises(ValueError, match="write 'module:attribute'"):
        box(reference)


@pytest.mark.parametrize(
    ("module", "missing"),
    [
        ("no_such_module", "no_such_module"),
        ("no_such_module.below", "no_such_module"),
        ("json.no_such_part", "json.no_such_part"),
    ],
)
def test_a_missing_module_is_named(module: str, missing: str) -> None:
    space = box(f"{module}:name")
    with pytest.raises(ValueError, match=f"'{module}:name': there is no module '{missing}'"):
        _ = space.problem


def test_a_dependency_missing_inside_the_module_is_reported_as_such(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_something.py").write_text("import no_such_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    space = box("needs_something:problem")
    with pytest.raises(ModuleNotFoundError, match="no_such_dependency"):
        _ = space.problem
