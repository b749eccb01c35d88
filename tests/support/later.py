"""A plugin of pytest: for tests and what they call in their process, it is a year later.

The registry and its keys have dates, and a stored example may expire. Processes that tests start, such as a database,
have the real time; so have timeouts, which are measured by the monotonic clock.
"""

from datetime import UTC, datetime, timedelta

import pytest
import time_machine

DAYS = 400


def pytest_configure(config: pytest.Config) -> None:
    clock = time_machine.travel(datetime.now(UTC) + timedelta(days=DAYS), tick=True)
    clock.start()
    config.add_cleanup(clock.stop)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "ray_server" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.skip(reason="the reports of its replicas are a year old"))
