"""Statistics and verdicts do not depend on the BLAS kernels and vector instructions of the processor."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

ROOT = Path(__file__).parents[3]

CORES = {
    "Prescott": ("SSE3",),
    "Haswell": ("AVX2", "FMA3"),
    "Zen": ("AVX2", "FMA3"),
    "SkylakeX": ("AVX2", "FMA3", "AVX512F", "AVX512_SKX"),
}
"""OpenBLAS core type → processor features that its kernels use."""

AVX512 = [name for name in __cpu_dispatch__ if name.startswith("AVX512") or name == "X86_V4"]
DISPATCHED = list(__cpu_dispatch__)


def _supports(*features: str) -> bool:
    return all(__cpu_features__.get(feature, False) for feature in features)


def _settings() -> dict[str, dict[str, str]]:
    """Name → environment variables, for the settings supported by this processor."""
    settings = {name: {"OPENBLAS_CORETYPE": name} for name, needed in CORES.items() if _supports(*needed)}
    for name, disabled in (("without AVX-512", AVX512), ("baseline", DISPATCHED)):
        if present := [feature for feature in disabled if _supports(feature)]:
            settings[name] = {"NPY_DISABLE_CPU_FEATURES": " ".join(present)}
    return settings


SETTINGS = _settings()

RECORD = """
import sys
from pathlib import Path
from evaluation.gating.nightly import nightly
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, WEAK, league_of
registry = league_of(Path(sys.argv[1]), WEAK, MIDDLING, STRONG)
nightly(CONFIG, registry=registry)
"""

VERIFY = """
import sys
from pathlib import Path
from evaluation.gating.verification import verify
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.tictactoe import LEAGUE
registry = Registry.open(Storage.at(Path(sys.argv[1])))
verdicts = registry.verdicts.all(LEAGUE)
assert {verdict.outcome for verdict in verdicts} >= {"promote"}
for verdict in verdicts:
    verify(verdict.id, registry=registry, replays=4)
print("verified", len(verdicts))
"""


def run(arguments: list[str], setting: dict[str, str]) -> str:
    """The output of a Python process with a setting; asserts that it succeeds."""
    environment = {**os.environ, **setting, "PYTHONPATH": str(ROOT)}
    process = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stdout[-4000:] + process.stderr[-4000:]
    return process.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SETTINGS)
def test_the_statistics_tests_pass(name: str) -> None:
    run(
        ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow", "tests/evaluation/statistics"],
        SETTINGS[name],
    )


@pytest.fixture(scope="module", params=["default", "baseline"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of a league whose verdicts were computed with one setting."""
    home = tmp_path_factory.mktemp("recorded")
    run(["-c", RECORD, str(home)], SETTINGS.get(request.param, {}))
    return home


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_verdict_verifies_with_each_setting(recorded: Path) -> None:
    for setting in ({}, *SETTINGS.values()):
        assert "verified 3" in run(["-c", VERIFY, str(recorded)], setting)
