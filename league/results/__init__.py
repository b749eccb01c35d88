"""What was played: plain records and the append-only ledger."""
