"""How the documentation is built: sphinx-build -W docs build/docs."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import references  # noqa: E402

from pchem_pipeline import __version__  # noqa: E402

project = "pchem_pipeline"
author = "the pchem_pipeline authors"
project_copyright = "the pchem_pipeline authors, MIT licence"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["README.md"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
# the tutorial is kept with its outputs, and executed by the tests
nb_execution_mode = "off"
autodoc_typehints = "none"
smartquotes = False
html_theme = "furo"
html_title = "pchem_pipeline"


def setup(app):
    """Write the pages that are made from the code before any page is read."""
    app.connect("builder-inited", lambda app: references.write_pages(HERE / "reference"))
