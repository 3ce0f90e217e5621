"""Training, tuning and self-play of attackers and defenders."""
