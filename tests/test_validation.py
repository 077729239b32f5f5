"""Checks of numbers, flags and choices: what they take, what they refuse, and what they say."""

from typing import Any

import numpy as np
import pytest
import torch as th

from errors import Message, raises
from sb3_yann._validation import (
    check_bool,
    check_choice,
    check_int,
    check_number,
    check_positive_vector,
    check_range,
    to_float,
)


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.int64(2), np.array(2.0)])
def test_numbers_of_python_and_numpy_become_floats(value: Any) -> None:
    assert (check_number("x", value), type(check_number("x", value))) == (2.0, float)


@pytest.mark.parametrize("value", [True, np.True_, "2", None, 2j, [2.0], np.array([2.0])])
def test_what_is_no_real_number_is_refused_with_a_hint(value: Any) -> None:
    with pytest.raises(TypeError, match=r"x = .* must be a number\. Give 3\."):
        check_number("x", value, "Give 3.")


BAD: list[tuple[Any, tuple[Any, ...], Message]] = [
    (check_number, (np.nan,), "x = nan must be a finite number"),
    (check_number, (-np.inf,), "x = -inf must be a finite number"),
    (check_range, (np.inf, 1, np.inf), "x = inf must be a finite number of at least 1"),
    (check_range, (-1, 0, 1), "x = -1 must be between 0 and 1"),
    (check_range, (np.nan, 0, 1), "x = nan must be between 0 and 1"),
    (check_positive_vector, ([1, 0], 2), r"\[1\.0, 0\.0\] must be above 0 in each entry"),
    *((check_bool, (x,), TypeError("x = .* True or False")) for x in (0, 1, "no", None)),
    *((check_int, (x,), "whole number of at least 1") for x in (True, 2.0, "2", None, 0)),
    (check_range, ([[1], [1, 2]], 0, 2), TypeError(r"x = \[\[1\], \[1, 2\]\] must be a number")),
    (check_range, ("1e-1", 0, 1), TypeError("x = '1e-1' must be a number. In YAML 1e-1 is a str")),
    (check_range, (10**30, 0, 2), "x = 10{30} must be between 0 and 2"),
]


@pytest.mark.parametrize(("check", "given", "message"), BAD)
def test_what_is_refused_is_named_with_what_was_expected(check, given, message) -> None:
    with raises(message):
        check("x", *given)


def test_what_is_allowed_comes_back_as_pythons_own() -> None:
    assert [check_range("x", x, 0, 1) for x in (0, 1)] == [0, 1]
    assert check_positive_vector("x", 2, 3).tolist() == [2, 2, 2]
    assert (check_int("x", np.int64(3)), type(check_int("x", np.int64(3)))) == (3, int)
    assert (check_bool("x", True), check_bool("x", np.False_)) == (True, False)
    assert check_choice("x", "a", ("a", "b")) == "a"


@pytest.mark.parametrize("as_list", [False, True])
def test_a_tensor_with_a_gradient_is_refused_with_the_word_detach(as_list: bool) -> None:
    tensor = th.zeros(2, requires_grad=True)
    with pytest.raises(TypeError, match=r"x is not an array of real .*: pass x\.detach\(\)\."):
        to_float("x", [tensor, tensor] if as_list else tensor)


@pytest.mark.parametrize("digits", [400, 5000])  # Python writes out no more than 4300
@pytest.mark.parametrize("check", [check_number, check_int, to_float])
def test_a_whole_number_that_no_float_holds_is_named(check: Any, digits: int) -> None:
    with pytest.raises((TypeError, ValueError), match=r"^x = .* (must be|is not) "):
        check("x", 10**digits)
