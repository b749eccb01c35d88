"""`check-env` and `league init` say of environments what was recorded: see `tests.support.findings`."""

import pytest

from tests.support.closeness import close
from tests.support.findings import SLOW, cases
from tests.support.recordings import read

CASES = cases()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if SLOW.search(name) else [], id=name) for name in CASES]
)
def test_findings_are_those_that_were_recorded(name: str) -> None:
    if "openspiel" in name or name == "liars_dice.yaml":
        pytest.importorskip("pyspiel")
    document, recorded = CASES[name].document(), read("findings")[name]
    # The last digits of floats differ between processors.
    assert close(document, recorded, tolerance=1e-6), f"{document}, expected {recorded}"


def test_all_cases_are_recorded() -> None:
    assert CASES.keys() == read("findings").keys()
