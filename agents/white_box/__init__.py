"""Attacks that know the model of the plant or the defence."""
