"""Statistics of match results: sequential tests, ratings, payoff matrices and population measures."""
