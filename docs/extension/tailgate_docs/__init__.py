"""The pages that `make docs` makes from code, files and boards, and the Sphinx extension (site.py)."""
