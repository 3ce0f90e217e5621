"""Scenarios, suites and training presets, as package data."""
