"""Results: records of matches, their scores and the append-only ledger."""
