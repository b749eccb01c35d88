"""Commands that play, judge and report."""
