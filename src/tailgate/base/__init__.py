"""Errors, files, locks, sizes, processes and plots, which every other room uses."""
