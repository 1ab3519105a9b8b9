"""The documentation as a site, for Sphinx: `make site` builds it into site/.

Sphinx reads the pages where they stand, from the repository's folder on, so that their links to each other, to
scenarios and to code hold. Search needs no server: it works on pages opened as files.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pygments.lexers.special import TextLexer

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "vnet"
copyright = "the vnet maintainers"  # Sphinx's own name for this setting
root_doc = "docs/index"
include_patterns = ["docs/**.md", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # tables of paper.md stand two levels below their section
exclude_patterns = ["docs/site"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_class_signature = "separated"
autodoc_default_options = {"exclude-members": "__init__, disconnect"}  # vnet calls these, not its users
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "vnet"
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
html_extra_path = ["index.html"]
html_theme_options = {"navigation_with_keys": True}

_HEADING = re.compile(r"^\*\*(.+?)\*\*")
_PAGE = re.compile(r"\]\(([^()\s#]+?\.md)(?:#[^()\s]*)?\)")


def contents(index: str) -> str:
    """Return the site's table of contents, in the order of docs/index.md: a part for each of its headings.

    Args:
        index: the text of docs/index.md: headings in bold type, each followed by links to pages.

    Returns:
        Directives of Sphinx, hidden on the page itself.
    """
    parts = []
    for section in re.split(r"^(?=\*\*)", index, flags=re.MULTILINE)[1:]:
        heading = _HEADING.match(section)
        assert heading is not None, section
        pages = "\n".join(dict.fromkeys(_PAGE.findall(section)))
        parts.append(f"```{{toctree}}\n:hidden:\n:caption: {heading[1].rstrip(':')}\n\n{pages}\n```\n")
    return "\n".join(parts)


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the table of contents to the first page, as Sphinx reads it."""
    if page == root_doc:
        source[0] += "\n" + contents(source[0])


def setup(app: Sphinx) -> None:
    """Connect what this configuration does itself."""
    app.connect("source-read", add_contents)
    app.add_lexer("csv", TextLexer)  # Pygments knows none
