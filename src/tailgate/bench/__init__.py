"""The speed of this package and of the peers that are installed (`tailgate bench`)."""
