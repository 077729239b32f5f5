"""How `make docs` builds the site from the pages in this folder; nothing is fetched from a network.

The pages are read on GitHub as well, so they hold no directive of Sphinx. What the site needs
besides is added here: the tree of pages from the list in index.md, the API, formulas as MathML.
"""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

HERE = Path(__file__).parent
MADE = HERE / "_made"
"""Pages that are written anew by each build."""
API = {
    "sb3_yann": "Problems, policy, guard",
    "sb3_yann.wrappers": "Wrappers",
    "sb3_yann.evaluation": "Evaluation",
    "sb3_yann.evaluation.plots": "Pictures",
    "sb3_yann.control": "Laws and models",
    "sb3_yann.commissioning": "Commissioning",
    "sb3_yann.networks": "Networks",
    "sb3_yann_envs": "Environments",
}
"""Packages and their titles. What two of them export stands under the first."""
ENVS = {"ClippedPendulumEnv": "clipped_pendulum", "CSTREnv": "cstr"}
"""Modules of the environments. Their docstrings are Markdown, as those of Gymnasium."""
OUTSIDE = ("README", "CONTRIBUTING", "CHANGELOG")

project = "sb3-yann"
author = copyright = "the sb3-yann authors"
version = release = importlib.import_module("sb3_yann").__version__
root_doc = "index"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_static", "_templates"]

html_theme = "furo"
html_title = f"sb3-yann {release}"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_google_docstring = False
# The types of parameters are words, "array_like, shape (n,)": no names to look up.
napoleon_use_param = False
napoleon_use_rtype = False
suppress_warnings = ["ref.python"]  # such words that attributes of two classes are called, too


def write_pages(*_: Any) -> None:
    """Write what lies outside this folder, or in docstrings, as pages."""
    shutil.rmtree(MADE, ignore_errors=True)
    MADE.mkdir()
    for name in OUTSIDE:
        text = (HERE.parent / f"{name}.md").read_text(encoding="utf-8")
        text = text.replace("](docs/", "](../").replace("](LICENSE", "](../../LICENSE")
        for each in OUTSIDE:
            text = text.replace(f"]({each}.md", f"]({each.lower()}.md")
        (MADE / f"{name.lower()}.md").write_text(text, encoding="utf-8")
    for name, home in ENVS.items():
        env = getattr(importlib.import_module(f"sb3_yann_envs.{home}"), name)
        (MADE / f"{name}.md").write_text(f"# {name}\n\n{inspect.getdoc(env)}\n", encoding="utf-8")
    (MADE / "api.rst").write_text(api_page(), encoding="utf-8")


def api_page() -> str:
    """Return the page that lists the public names, each with a page of its own."""
    lines, seen = ["API", "===", ""], set[int]()
    for package, title in API.items():
        module = importlib.import_module(package)
        values = {id(getattr(module, name)): name for name in module.__all__}
        names = sorted(name for key, name in values.items() if key not in seen)
        seen |= {*values}
        lines += ["", title, "-" * len(title), "", f".. currentmodule:: {package}", ""]
        lines += [".. autosummary::", "   :toctree: api", "   :nosignatures:", ""]
        lines += [f"   {name}" for name in names]
    lines += ["", ".. toctree::", "   :maxdepth: 1", "", *(f"   {name}" for name in ENVS), ""]
    return "\n".join(lines)


def read_page(_: Any, name: str, source: list[str]) -> None:
    """Lead links out of this folder to the pages made of them; make a tree of the index's lists."""
    text = source[0]
    for each in OUTSIDE:
        text = text.replace(f"](../{each}.md", f"](_made/{each.lower()}.md")
    if name == root_doc:
        for title, body in re.findall(r"^## (.+)\n((?:.|\n)+?)(?=^## |\Z)", text, re.MULTILINE):
            pages = "\n".join(re.findall(r"^\d+\. \[.*?\]\((.+?)\.md\)", body, re.MULTILINE))
            text += f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{pages}\n```\n"
        text += "\n```{toctree}\n:hidden:\n:caption: Reference\n\n_made/api\n```\n"
    source[0] = text


def write_formula(translator: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers draw without a script or a font of ours."""
    block = isinstance(node, nodes.math_block)
    try:
        formula = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logging.getLogger(__name__).warning("%s", error, location=node)
        raise nodes.SkipNode from error
    translator.body.append(f'<div class="math">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Join in where Sphinx reads its settings, reads a page, and writes a formula."""
    app.connect("config-inited", write_pages)
    app.connect("source-read", read_page)
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
