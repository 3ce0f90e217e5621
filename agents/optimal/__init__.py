"""Optimal attacks: ceilings by dynamic programming."""
