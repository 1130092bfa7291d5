"""Configure the site that `make docs` builds from these pages: Sphinx, MyST, the theme furo."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "site"))

import gsbench  # noqa: E402  only after the path is set, as all that follows

project = "gsbench"
author = copyright = "the gsbench maintainers"
release = version = gsbench.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "source_pages"]
exclude_patterns = ["site"]
default_role = "code"  # `name` in a docstring is code, as in Markdown
highlight_language = "none"  # of a block that names no language
smartquotes_action = "D"  # dashes and no quotes: autodoc writes "name -- what it is"

html_theme = "furo"
html_title = f"gsbench {release}"
html_static_path, html_css_files = ["static"], ["site.css"]
html_show_sourcelink = html_copy_source = False
pygments_style, pygments_dark_style = "default", "github-dark"

myst_heading_anchors = 4  # links to headings work as on GitHub

autodoc_typehints = "description"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
napoleon_google_docstring, napoleon_numpy_docstring = True, False
