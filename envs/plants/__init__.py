"""Plants: what moves, one file each."""
