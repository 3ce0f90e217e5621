"""Plants: the moving systems, one file each."""
