"""The Structured Text of an export is the controller, step by step, faults included."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from deployed import CASES, error, observations, policy_of
from sb3_yann import Checks, Controller, export
from sb3_yann.deployment.code import insensitive
from sb3_yann.deployment.controller import Status
from structured_text import FunctionBlock


def both(name, folder, **options):
    export(policy_of(name), folder / "plant.npz", **options)
    export(policy_of(name), folder / "plant.st", **options)
    return Controller.load(folder / "plant.npz"), FunctionBlock((folder / "plant.st").read_text())


@pytest.mark.parametrize("name", CASES)
def test_a_block_is_the_policy(name, tmp_path):
    controller, block = both(name, tmp_path)
    obs = insensitive(controller, observations(policy_of(name), 160), "double")
    assert len(obs) > 60
    for row in obs:
        command, status, mode = block.step(obs=list(row), request=0)
        assert mode == 0
        assert error(command, controller.evaluate(row), controller) < 1e-12
        assert status == (0 if controller.in_domain(row) else Status.OUTSIDE)


def test_plcopen_holds_the_same_block(tmp_path):
    export(policy_of("reactor"), tmp_path / "plant.st")
    export(policy_of("reactor"), tmp_path / "plant.xml")
    space = "{http://www.plcopen.org/xml/tc6_0201}"
    root = ElementTree.parse(tmp_path / "plant.xml").getroot()
    assert root.tag == f"{space}project"
    (pou,) = root.iter(f"{space}pou")
    assert pou.attrib == {"name": "plant", "pouType": "functionBlock"}
    body = "".join(pou.find(f"{space}body").itertext())
    text = (tmp_path / "plant.st").read_text()
    assert body.strip() in text
    block = FunctionBlock(text)
    tables = {}
    for variable in pou.iter(f"{space}variable"):
        values = variable.find(f"{space}initialValue/{space}arrayValue")
        if values is not None:
            tables[variable.get("name").lower()] = [
                float(each.find(f"{space}simpleValue").get("value"))
                for each in values
                for _ in range(int(each.get("repetitionValue", 1)))
            ]
    assert {"a", "gains", "layer0", "starts"} <= set(tables)
    assert all(np.array_equal(block.vars[name], each) for name, each in tables.items())
    named = [each.get("name") for each in root.find(f".//{space}inputVars")]
    assert named == ["obs", "elapsed", "request", "has_manual", "manual"]


@pytest.mark.nightly  # it takes a millisecond for each letter
def test_blark_parses_it(tmp_path):
    parse = pytest.importorskip("blark.parse").parse_source_code
    export(policy_of("references and rates"), tmp_path / "plant.st")
    text = (tmp_path / "plant.st").read_text()
    short = re.sub(r":= \[([^],]*),[^]]*\];", r":= [\1];", text)  # it takes minutes for tables
    assert len(short) < len(text) / 3
    assert parse(short).exception is None
    block = "FUNCTION_BLOCK it\nWHILE i < 3 DO\n i := i + 1;\nEND_WHILE;\nEND_FUNCTION_BLOCK\n"
    assert parse(block).exception is None
    assert parse(block.replace("END_WHILE", "END_WHIL")).exception is not None


def test_single_precision_is_real(tmp_path):
    export(policy_of("reactor"), tmp_path / "plant.st", precision="float")
    text = (tmp_path / "plant.st").read_text()
    assert "LREAL" not in text and "DINT_TO_REAL" in text
    block = FunctionBlock(text)  # in Python's doubles, with tables of floats
    export(policy_of("reactor"), tmp_path / "plant.npz")
    controller = Controller.load(tmp_path / "plant.npz")
    for row in insensitive(controller, observations(policy_of("reactor"), 50), "float"):
        command, _, _ = block.step(obs=list(row), request=0)
        assert error(command, controller.evaluate(row), controller) < 1e-5


@pytest.mark.parametrize("name", CASES)
def test_no_name_is_taken_twice_whatever_its_case(name, tmp_path):
    export(policy_of(name), tmp_path / "plant.st")
    text = re.sub(r"\(\*.*?\*\)", "", (tmp_path / "plant.st").read_text(), flags=re.S)
    names = [each.lower() for each in re.findall(r"^\s*(\w+) : ", text, flags=re.M)]
    assert len(names) > 30 and len(names) == len(set(names))


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", ["reactor", "two inputs, zero input", "references and rates"])
def test_it_is_what_matiec_compiles_rightly(name, precision, tmp_path):
    checks = Checks(late_after=None)
    export(policy_of(name), tmp_path / "plant.st", precision=precision, checks=checks)
    text = re.sub(r"\(\*.*?\*\)", "", (tmp_path / "plant.st").read_text(), flags=re.S)
    assert "END_WHILE" in text and not re.search(r"\bFOR\b", text)
    literals = [abs(float(each)) for each in re.findall(r"\d+\.\d+(?:e[-+]?\d+)?", text)]
    assert len(literals) > 200 and all(x == 0 or 1e-37 <= x <= 1e38 for x in literals)
