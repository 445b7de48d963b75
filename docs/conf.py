"""The site of these pages: pip install '.[docs]' && sphinx-build -W docs site."""

from agalign import __version__

project = "agalign"
copyright = "the agalign authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
autodoc_typehints = "description"
exclude_patterns = ["_build"]
autodoc_member_order = "bysource"
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"agalign {__version__}"
