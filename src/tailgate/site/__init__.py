"""The site of boards: a page of all suites, a page per entry with its replay, and the page of rows alone."""
