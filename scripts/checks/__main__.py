"""`python -m scripts.checks` prints the faults that the checks of this package find, and exits with 1 if there is any.

A check is a function `check_…` without arguments that yields faults: sentences that name the place.
"""

import sys

from scripts.checks import docs, layout, names, release

faults = [
    fault
    for module in (names, layout, docs, release)
    for name, check in vars(module).items()
    if name.startswith("check_")
    for fault in check()
]
sys.exit("\n".join(faults) or 0)
