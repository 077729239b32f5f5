"""The quick form of the experiments: the command itself, from its runs to its report."""

from __future__ import annotations

import re

import pytest

from fresh_process import run_module


@pytest.mark.nightly
def test_the_quick_form_runs_to_its_report_and_does_nothing_twice(tmp_path) -> None:
    assert "9 of 9 runs" in run_module(tmp_path, "experiments", "--quick")
    folder = tmp_path / "out" / "paper-quick"
    report = (folder / "results.md").read_text(encoding="utf-8")
    assert "## After 4 training episodes" in report
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", report):
        assert (folder / picture).stat().st_size > 10_000
    before = (folder / "results.sqlite").read_bytes()
    run_module(tmp_path, "experiments", "--quick")
    assert (folder / "results.sqlite").read_bytes() == before
