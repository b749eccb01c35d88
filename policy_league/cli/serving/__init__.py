"""Commands about policy servers."""
