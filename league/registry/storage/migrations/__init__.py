"""Migrations of the schema. KNOWN lists the revisions in `versions/`, oldest first."""

KNOWN = ("0001", "0002", "0003", "0004")
HEAD = KNOWN[-1]
