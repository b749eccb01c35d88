"""What the linter and the type checker cannot see: names, layout, documentation and what a release consists of."""
