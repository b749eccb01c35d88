"""Single games to watch and to play: replays, recorded steps, videos and human play."""
