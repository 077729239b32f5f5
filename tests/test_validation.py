"""Checks of numbers, flags and choices: what they take, what they refuse, and what they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_yann._validation import (
    as_between,
    as_choice,
    as_flag,
    as_number,
    as_positive,
    as_positive_vector,
    as_whole,
)


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.int64(2), np.array(2.0)])
def test_numbers_of_python_and_numpy_become_floats(value: Any) -> None:
    assert (as_number("x", value), type(as_number("x", value))) == (2.0, float)


@pytest.mark.parametrize("value", [True, np.True_, "2", None, 2j, [2.0], np.array([2.0])])
def test_what_is_no_real_number_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match=r"x = .* must be a number\. Give 3\."):
        as_number("x", value, "Give 3.")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_are_finite(value: float) -> None:
    for check in (as_number, as_positive, lambda name, x: as_between(name, x, 0, np.inf)):
        with pytest.raises(ValueError, match="must be a finite number"):
            check("x", value)


@pytest.mark.parametrize(
    ("value", "ends", "message"),
    [
        (-1, "[]", "x = -1 must be between 0 and 1"),
        (0, "(]", r"x = 0 must lie in \(0, 1\]"),
        (1, "[)", r"x = 1 must lie in \[0, 1\)"),
        (np.nan, "[]", "x = nan must be between 0 and 1"),
    ],
)
def test_limits_are_named(value: float, ends: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        as_between("x", value, 0, 1, ends)


def test_limits_with_square_ends_are_allowed() -> None:
    assert [as_between("x", x, 0, 1) for x in (0, 1)] == [0, 1]


def test_a_positive_vector_takes_one_number_for_all() -> None:
    assert as_positive_vector("scale", 2, 3).tolist() == [2, 2, 2]
    with pytest.raises(ValueError, match=r"scale = \[1\.0, 0\.0\] must be above 0 in each entry"):
        as_positive_vector("scale", [1, 0], 2)


@pytest.mark.parametrize("value", [True, 2.0, "2", None, 0])
def test_what_is_no_whole_number_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="n = .* must be a whole number of at least 1"):
        as_whole("n", value)


def test_whole_numbers_of_numpy_become_ints() -> None:
    assert type(as_whole("n", np.int64(3))) is int


@pytest.mark.parametrize("value", [0, 1, "no", None])
def test_a_flag_is_true_or_false(value: Any) -> None:
    assert (as_flag("f", True), as_flag("f", np.False_)) == (True, False)
    with pytest.raises(TypeError, match="f = .* must be True or False"):
        as_flag("f", value)


def test_a_choice_is_one_of_the_options() -> None:
    assert as_choice("c", "a", ("a", "b")) == "a"
    with pytest.raises(ValueError, match=r"c = 'd' must be one of \('a', 'b'\)"):
        as_choice("c", "d", ("a", "b"))
