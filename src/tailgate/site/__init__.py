"""The static leaderboard: rows in, one HTML page out."""
