"""The documentation site: `make docs` builds it into build/site. The pages are docs/*.md."""

from __future__ import annotations

import inspect
import re
from importlib import metadata
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import rendezview

project = "rendezview"
author = "the authors of rendezview"
html_show_copyright = False
release = metadata.version("rendezview")
version = release

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
exclude_patterns = ["site/**"]
master_doc = "index"

html_theme = "furo"
html_title = "rendezview"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b6aa2", "color-brand-content": "#0b6aa2"},
    "dark_css_variables": {"color-brand-primary": "#56b4e9", "color-brand-content": "#56b4e9"},
}
html_show_sourcelink = False
html_copy_source = False

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
# The notebook is run at every build; an error in a cell is an error of the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # s. Source: ten times what it takes on two quiet cores
nb_merge_streams = True
nb_output_stderr = "remove"

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False}
autodoc_preserve_defaults = True
autodoc_type_aliases = {"Array": "Array", "GreyImage": "GreyImage", "npt.ArrayLike": "ArrayLike"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False

_ROOT = Path(__file__).resolve().parents[2]
_OUTSIDE = re.compile(r"\[([^\]]+)\]\((\.\./[^)#]+)(#[^)]*)?\)")


def _name_files_outside(app: Sphinx, page: str, source: list[str]) -> None:
    """Links to files of the repository that are no pages: their path is shown instead."""

    def path(match: re.Match[str]) -> str:
        place = ((_ROOT / "docs" / page).parent / match[2]).resolve()
        if not place.exists():
            raise FileNotFoundError(f"docs/{page}: there is no {match[2]}")
        words, name = match[1].strip("`"), str(place.relative_to(_ROOT))
        return f"`{name}`" if words in name else f"{match[1]} (`{name}`)"

    source[0] = _OUTSIDE.sub(path, source[0])


def _keep_notes_aside(app: Sphinx, page: str, source: list[str]) -> None:
    """Notes are for maintainers: built and linked, but in no sidebar and not in the search."""
    if page.startswith("notes/"):
        source[0] = "---\norphan: true\nnosearch: true\n---\n\n" + source[0]


def _field_comments(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """The comment beside or above a dataclass field, which gives its unit, as its description."""
    if what != "attribute" or lines:
        return
    owner, _, field = name.rpartition(".")
    found = getattr(rendezview, owner.removeprefix("rendezview."), None)
    for base in getattr(found, "__mro__", ()):
        if field in getattr(base, "__annotations__", {}):
            comment = _comment_of(inspect.getsource(base).splitlines(), field)
            if comment:
                lines[:] = [comment]
            return


def _comment_of(source: list[str], field: str) -> str:
    for number, line in enumerate(source):
        if not re.match(rf"    {re.escape(field)}: ", line):
            continue
        _, mark, beside = line.partition("  # ")
        above = []
        while not mark and source[number - 1].strip().startswith("# "):
            number -= 1
            above.insert(0, source[number].strip()[2:])
        return (beside or " ".join(above)).replace("*", r"\*").strip()
    return ""


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _name_files_outside)
    app.connect("source-read", _keep_notes_aside)
    app.connect("autodoc-process-docstring", _field_comments)
