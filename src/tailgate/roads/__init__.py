"""Recordings of real roads: models fitted to them, defences run over them, and episodes written in the field's formats."""
