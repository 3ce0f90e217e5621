"""What this package measures of its own speed, beside the peers that are installed (spec of speed; `tailgate bench`)."""
