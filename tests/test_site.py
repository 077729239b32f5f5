"""The pages build as a site, without a warning; its pictures are small, and shown."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
PICTURES = sorted((DOCS / "pictures").glob("*.png"))
MOST_BYTES = 60_000


@pytest.mark.nightly
@pytest.mark.skipif(find_spec("myst_parser") is None, reason="Sphinx is not installed: make docs")
def test_the_site_builds_without_a_warning_and_loads_nothing(tmp_path) -> None:
    options = ["--quiet", "--fail-on-warning", "--keep-going", "-d", tmp_path / "trees"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, DOCS, tmp_path / "html"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
    for path in (tmp_path / "html").rglob("*.html"):
        loaded = re.findall(
            r"<(?:script|link|img)[^>]*(?:src|href)=\"(https?:[^\"]*)", path.read_text("utf-8")
        )
        assert loaded == [], path
    assert (tmp_path / "html" / "_made" / "api" / "sb3_yann.YannPolicy.html").exists()
    assert "<math" in (tmp_path / "html" / "how_it_works.html").read_text("utf-8")


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.stem)
def test_a_picture_is_small_and_on_a_page(path) -> None:
    assert path.stat().st_size < MOST_BYTES
    assert any(f"](pictures/{path.name})" in page.read_text("utf-8") for page in DOCS.glob("*.md"))
