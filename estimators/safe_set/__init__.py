"""Defences that keep the state in a safe set (thesis chapter 4)."""
