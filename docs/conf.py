"""The site of these pages: pip install 'agalign[docs]' && sphinx-build -W docs site."""

from agalign import __version__

project = "agalign"
copyright = "the agalign authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 3
# Pages lead to files of the repository too, which are no pages; a test holds that they are there.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "description"
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"agalign {__version__}"
