"""Single games for people: replays, recorded steps, videos and human play."""
