"""Falsification: the episode that breaks a property, and how rare one is without a search for it."""
