"""Errors, files, locks, sizes, processes and plots: the ground floor, which all other rooms use."""
