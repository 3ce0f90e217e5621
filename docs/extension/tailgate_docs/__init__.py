"""What `make docs` makes from code, files and boards: the pages, and the Sphinx extension (site.py)."""
