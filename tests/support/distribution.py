"""A plugin of pytest that distributes the test files among processes, and rejects a run that left tests out.

A file is run by one process. Files that share a server or a Ray session are run by the same one, so that each is
started once.
"""

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
SHARED = ("ray_session", "ray_server")
"""Session fixtures that take long to set up. The tests of the first are the longest chain."""
SECONDS = {
    "tests/cluster/test_autoscaler.py": 60,
    "tests/serve_app/test_autoscaling.py": 39,
    "tests/evaluation/gating/test_training_night.py": 60,
    "tests/evaluation/gating/test_nightly.py": 30,
    "tests/training/runs/test_train.py": 26,
    "tests/test_tutorial.py": 25,
    "tests/benchmarks/": 20,
    "tests/serve_app/test_attacks.py": 30,
    "tests/test_wheel.py": 15,
    "tests/league/local_ray/": 10,
    "tests/training/test_learning.py": 10,
    "tests/training/algorithms/": 8,
    "tests/serve_app/test_faults.py": 7,
    "tests/test_restore_parity.py": 6,
    "tests/browser/": 3,
    "tests/test_environments.py": 3,
}
"""Processor time of a slow test of these files and folders, about; of any other test, a second. Wrong values cost time
only: long files that start last leave a process without work."""
_reported: set[str] = set()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    from xdist.scheduler import LoadScopeScheduling

    if missing := [path for path in SECONDS if not (ROOT / path).exists()]:
        raise pytest.UsageError(f"{__name__}: SECONDS names {missing[0]}, which does not exist")

    class BySharedResource(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _shared_resource(config.rootpath / nodeid.partition("::")[0])

        def remove_node(self, node: Any) -> str | None:
            """Distribute what a crashed process left, except the test in which it crashed, which has failed.

            xdist 3.8.0 also queues the tests that the process had finished, waits for them, and never ends:
            https://github.com/pytest-dev/pytest-xdist/issues/1323
            """
            units = {scope: unit for scope, unit in self.assigned_work.pop(node).items() if not all(unit.values())}
            unfinished = [(unit, test) for unit in units.values() for test, is_done in unit.items() if not is_done]
            if not unfinished:
                return None
            unit, crashed = unfinished[0]
            unit[crashed] = True
            self.workqueue.update({scope: unit for scope, unit in units.items() if not all(unit.values())})
            for other in self.assigned_work:
                self._reschedule(other)
            return crashed

        def schedule(self) -> None:
            """Give a process that replaces a crashed one a second unit: it runs a test only when it knows the next."""
            is_replacement = self.collection is not None
            super().schedule()
            for node in self.nodes if is_replacement else ():
                if not node.shutting_down and self._pending_of(self.assigned_work[node]) < 2:
                    self._reschedule(node)

    config.option.loadscopereorder = False  # by the number of tests
    return BySharedResource(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let each of several processes start with the files that take longest."""
    if hasattr(config, "workerinput"):
        seconds = Counter[str]()
        scopes = {item: _shared_resource(item.path) for item in items}
        for item, scope in scopes.items():
            seconds[scope] += next((SECONDS[path] for path in SECONDS if item.nodeid.startswith(path)), 1)
        items.sort(key=lambda item: (scopes[item] != SHARED[0], -seconds[scopes[item]]))


@cache
def _shared_resource(path: Path) -> str:
    if path.parent.name == "browser":
        return "browser"
    text = path.read_text()
    return next((fixture for fixture in SHARED if fixture in text), str(path))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _reported.add(report.nodeid)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Let a run in which tests were left out end with an internal error, after which nothing is repeated."""
    left_out = session.testscollected - len(_reported)
    if session.config.pluginmanager.hasplugin("dsession") and exitstatus in (0, 1) and left_out > 0:
        print(f"\n{left_out} tests did not run")
        session.exitstatus = pytest.ExitCode.INTERNAL_ERROR
