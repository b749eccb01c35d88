"""Migrations of the schema. KNOWN lists the revisions in `versions/`, oldest first."""

# fmt: off
KNOWN = (
    "0001", "0002", "0003", "0004", "0005", "0006", "0007", "0008", "0009", "0010", "0011", "0013", "0014", "0015",
    "0016", "0017", "0018", "0019",
)
# fmt: on
HEAD = KNOWN[-1]
