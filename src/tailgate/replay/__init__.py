"""One episode played again from its row: replay.py plays, page.py writes the page, video.py the film."""
