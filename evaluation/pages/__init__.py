"""What a person looks at: a league as one page."""
