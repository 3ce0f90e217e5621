"""Secure estimation: what is attacked is some of the sensors, and nobody knows which (thesis, chapter 2)."""
