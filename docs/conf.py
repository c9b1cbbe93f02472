"""Sphinx settings. Builds from this checkout, without a network."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.builders.text import TextBuilder
from sphinx.ext.napoleon import Config, GoogleDocstring

from mjlab.scripts.demo import DEMOS
from mjlab.scripts.describe import describe
from mjlab.tasks.registry import list_tasks
from mjlab.tasks.velocity import mdp as velocity_mdp

_ROOT = Path(__file__).resolve().parents[1]

project = "mjlab"
author = "the mjlab developers"
copyright = "2026, the mjlab developers. Apache License 2.0"
release = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]["version"]
version = release

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
extensions += ["sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3

# Browsers draw MathML themselves, so pages need neither scripts nor a network.
html_math_renderer = "mathml"

# Copy commands without their prompt.
copybutton_exclude = ".linenos, .gp, .go"

html_theme = "furo"
html_title = f"mjlab {release}"
html_static_path = ["_static"]
templates_path = ["_templates"]
html_css_files = ["mjlab.css"]
# List of the pages in plain Markdown, which stand beside the HTML: see `_write_markdown`.
html_extra_path = ["llms.txt"]
html_copy_source = False
# Lines under the headings of text, as in Markdown.
text_sectionchars = "=-~^+`"

html_theme_options = {
    "top_of_page_buttons": [],
    "light_css_variables": {"color-brand-primary": "#2f6690", "color-brand-content": "#2f6690"},
    "dark_css_variables": {"color-brand-primary": "#8fc1e3", "color-brand-content": "#8fc1e3"},
}

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True

# Show terms that accept older parameters with current ones: Sphinx reads defaults from the source.
for _term in vars(velocity_mdp).values():
    if hasattr(_term, "__wrapped__") and "__signature__" in vars(_term):
        del _term.__signature__

# Docstring style: Google sections, and `Params` for class-based terms (parameters of the term
# config).
_SECTIONS: Any = Config(
    napoleon_custom_sections=[("Params", "params_style")], napoleon_use_rtype=False
)

# A line that ends with a colon, followed by an indented formula or code.
_FORMULA = re.compile(r"(?m)^(\S.*):\n\n((?:    .*\n?|\n)+)")
_CODE = re.compile(r"(?<!`)`([^`]+)`(?!`)")


def _to_rst(app: Sphinx, what: Any, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Convert a docstring, plain text with backquotes around code, to reStructuredText."""
    # Three parts per formula: preceding text, the line above, and the formula.
    parts = _FORMULA.split("\n".join(lines))
    parts[0::3] = [_inline(part) for part in parts[0::3]]
    parts[1::3] = [f"{_inline(part)}::\n\n" for part in parts[1::3]]
    lines[:] = "".join(parts).split("\n")
    # Field docstrings have no sections: keep colons.
    if what not in ("attribute", "data", "property"):
        lines[:] = GoogleDocstring(lines, _SECTIONS, what=what).lines()


def _inline(text: str) -> str:
    """Mark code, and escape all other markup characters."""
    parts = _CODE.split(text)
    parts[0::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[0::2]]
    parts[1::2] = [f"``{' '.join(part.split())}``" for part in parts[1::2]]
    return "".join(parts)


def _readable(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, str | None] | None:
    """Shorten the signatures of configs, and complete those of `field_term`."""
    if what == "class" and dataclasses.is_dataclass(obj):
        # Fields are listed below, with their docstrings.
        return "", None
    if signature and "row.operation" in signature:
        return signature.replace("row.operation", repr(obj.row.operation)), returns
    return None


def _add_summary(app: Sphinx, name: str, source: list[str]) -> None:
    """Insert a table of classes and functions, with their first sentences, below the title."""
    listed = re.findall(r"(?m)^\.\. auto(?:class|function|data):: (\S+)", source[0])
    if name.startswith("reference/api/") and listed:
        title, rest = source[0].split("\n", 1)
        rows = "\n".join(f"   ~{path}" for path in listed)
        table = f".. autosummary::\n   :nosignatures:\n\n{rows}\n"
        source[0] = f"{title}\n\n```{{eval-rst}}\n{table}```\n{rest}"


def _math(display: str) -> tuple[Any, None]:
    def visit(self: Any, node: Any) -> None:
        tag = "div" if display == "block" else "span"
        formula = convert(node.astext(), display=display)
        self.body.append(self.starttag(node, tag, "", CLASS="math") + formula + f"</{tag}>")
        raise SkipNode

    return visit, None


def _add_task_tables(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the tables of all stock tasks to the page of tasks."""
    if page == "reference/tasks":
        names = [name for name in list_tasks() if name.startswith("Mjlab-")]
        source[0] += "".join(f"\n{describe(name).markdown()}\n" for name in names)


def _write_markdown(app: Sphinx, page: str, source: list[str]) -> None:
    """Write a page as plain Markdown beside its HTML, for readers without a browser."""
    if app.builder.format == "html" and not _is_api(page):
        _write_beside(app, page, re.sub(r"```{toctree}\n(?s:.*?)```\n*", "", source[0]))


def _write_api_text(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Write a page of the API as text: its source names classes, and has no docstrings."""
    if app.builder.format == "html" and _is_api(page):
        builder = TextBuilder(app, app.env)
        builder.init()
        text: Any = builder.create_translator(doctree, builder)
        doctree.walkabout(text)
        _write_beside(app, page, text.body)


def _is_api(page: str) -> bool:
    return page.startswith("reference/api/") and page != "reference/api/index"


def _write_beside(app: Sphinx, page: str, text: str) -> None:
    path = Path(app.outdir) / f"{page}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _share_demos(app: Sphinx) -> None:
    """Write the pages of the bundled policies that the gallery links, unless they are there."""
    for name in DEMOS if app.builder.format == "html" else ():
        page = Path(app.outdir) / "shared" / f"{name}.html"
        if not page.exists():
            page.parent.mkdir(exist_ok=True)
            command = ["-m", "mjlab.cli.main", "share", name, "--output", str(page)]
            subprocess.run([sys.executable, *command], check=True)


def setup(app: Sphinx) -> None:
    """Register the handlers of pages, docstrings, signatures and formulas."""
    app.add_html_math_renderer("mathml", _math("inline"), _math("block"))
    app.connect("builder-inited", _share_demos)
    app.connect("source-read", _add_summary)
    app.connect("source-read", _add_task_tables)
    app.connect("source-read", _write_markdown, priority=900)
    app.connect("doctree-resolved", _write_api_text)
    app.connect("autodoc-process-signature", _readable)
    app.connect("autodoc-process-docstring", _to_rst)
