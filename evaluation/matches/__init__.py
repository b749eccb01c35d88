"""Matches and tournaments: the lockstep game loop, forfeits, timeouts and the leaderboard."""
