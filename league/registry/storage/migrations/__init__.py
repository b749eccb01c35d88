"""Migrations of the schema. KNOWN lists the revisions in `versions/`, oldest first."""

KNOWN = ("0001",)
HEAD = KNOWN[-1]
