"""Baselines to compare with: no defence, the truth, and sentinels."""
