"""Names and units: checked, shown, and kept by what is made from a model."""

from __future__ import annotations

import dataclasses
import pickle
from typing import Any

import control
import numpy as np
import pytest

from sb3_yann import LinearModel

NAMES: dict[str, Any] = {
    "state_names": ["level", "T.top"],
    "input_names": ["pump"],
    "units": {"level": "cm", "pump": "V"},
}
A, B = [[0.9, 0.1], [0.0, 0.8]], [[1.0], [0.5]]


def test_names_and_units_are_shown() -> None:
    model = LinearModel(A, B, dt=1.0, **NAMES)
    report = model.report()
    assert "States: level (cm), T.top. Inputs: pump (V)." in report
    assert "Held at 1, pump moves the state to" in report
    assert repr(model).startswith("LinearModel(states=['level (cm)', 'T.top'], inputs=['pump (V)']")
    assert "x_ss=[0.0, 0.0]" in repr(model)
    assert model.units == ("cm", "", "V")


def test_names_are_kept_by_copies_and_do_not_count_in_equality() -> None:
    model, plain = LinearModel(A, B, dt=1.0, **NAMES), LinearModel(A, B, dt=1.0)
    assert model == plain
    assert hash(model) == hash(plain)
    for other in (
        dataclasses.replace(model, A=np.eye(2)),
        pickle.loads(pickle.dumps(model)),
        plain.named(**NAMES),
    ):
        assert other.state_names == ("level", "T.top")
        assert (other.input_names, other.units) == (model.input_names, model.units)


def test_naming_a_model_keeps_its_notes_and_drift() -> None:
    model = LinearModel(A, B, dt=1.0, notes=["from a log"], drift=[0.1, 0]).named(["a", "b"])
    assert (model.notes, model.drift.tolist()) == (("from a log",), [0.1, 0])


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"state_names": "ab"}, TypeError, "state_names = 'ab' must be a list of str"),
        ({"state_names": ["a"]}, ValueError, "must be 2 different names"),
        ({"state_names": ["a", "a"]}, ValueError, "must be 2 different names"),
        ({"state_names": ["a", "b"], "input_names": ["a"]}, ValueError, "'a'. name a state and an"),
        ({"state_names": ["u[0]", "b"]}, ValueError, "name a state and an input"),
        ({"input_names": [1]}, TypeError, "input_names = .* must be a list of str"),
        ({"units": {"speed": "m"}}, ValueError, "units has .'speed'., but the names are"),
        ({"units": ["m"]}, ValueError, "must have one entry for each of"),
        ({"units": {"x[0]": 1}}, TypeError, "must map names to str"),
    ],
)
def test_bad_names_are_named(changes: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LinearModel(A, B, dt=1.0, **changes)


def test_a_model_becomes_a_statespace_and_comes_back() -> None:
    model = LinearModel(A, B, dt=0.5, E=[[1], [2]], **NAMES)
    system = model.to_statespace()
    assert isinstance(system, control.StateSpace)
    assert system.input_labels == ["pump", "d[0]"]
    assert system.state_labels == ["level", "T_top"]
    assert LinearModel.from_statespace(system, disturbances=["d[0]"]) == model


def test_deviations_in_the_report_say_that_they_are() -> None:
    """A gain is no state: one unit more than u_ss moves the state from x_ss."""
    model = LinearModel(A, B, dt=1.0, x_ss=[12, 350], u_ss=[3], **NAMES)
    assert "Held at u_ss + 1, pump moves the state to x_ss + (12.5, 2.5)." in model.report()


@pytest.mark.parametrize(
    "name", ["T\x1b[31m", "T\n", "a\tb", "\x00", "\x7f", "\ud800", "a\u2028b", "\uffff"]
)
def test_what_is_no_text_is_refused_in_names_and_units(name: str) -> None:
    for given in ({"state_names": [name, "b"]}, {"input_names": [name]}, {"units": [name, "", ""]}):
        with pytest.raises(ValueError, match="holds a character that is no text"):
            LinearModel(A, B, dt=1.0, **given)
    LinearModel(A, B, dt=1.0, state_names=["\N{SNOWMAN}", "T\N{NO-BREAK SPACE}1"])
