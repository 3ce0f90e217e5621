"""Filters: an estimate from readings."""
