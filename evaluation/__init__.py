"""Evaluation of versions: matches, ratings, statistical gates, nightly runs, reports and playback."""
