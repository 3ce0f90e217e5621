"""The site of the documentation: `make docs` builds it into the folder `site`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extension"))

project = "Tailgate"
html_title = "Tailgate"
copyright = "The Tailgate developers, MIT licence"
extensions = ["myst_nb", "sphinx.ext.viewcode", "tailgate_docs.site"]
exclude_patterns = ["extension", "images"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # tests execute the notebooks; pages show what they hold
nb_merge_streams = True
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_search_summary = False  # a page opened from a folder may not read others
html_show_sourcelink = False
html_theme_options = {"top_of_page_buttons": []}
add_module_names = False
viewcode_line_numbers = True
viewcode_follow_imported_members = False  # pages name the module that defines
