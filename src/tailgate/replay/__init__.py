"""Replay of one episode from its row: replay.py plays it, page.py writes the page, video.py the film."""
