"""The kinds of tests that a candidate must pass. One module per kind: its schedule, decision, record and wording."""
