"""The multi-agent example environments that RLlib ships pass `league check-env`, or are refused with a reason."""

import importlib
import json
import pkgutil
import random
import re
from pathlib import Path

import numpy as np
import pytest
import ray.rllib.examples.envs.classes as examples
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from league.config.league import LeagueConfig
from league.environments.conformance.examination import examine

PAGE = Path(__file__).parents[2] / "docs" / "rllib-environments.md"
ROW = re.compile(r"^\| `([\w.]+:\w+)` \| (?:`(\{.*\})`)? \| (accepted|refused: (.+)) \|$", re.MULTILINE)

pytestmark = pytest.mark.slow


def listed() -> dict[str, tuple[dict, str | None]]:
    """Environment → its arguments, and the reason why it is refused, in the table of the page."""
    return {
        name: (json.loads(arguments or "{}"), reason or None)
        for name, arguments, _, reason in ROW.findall(PAGE.read_text())
    }


def shipped() -> set[str]:
    """All MultiAgentEnv classes under `ray.rllib.examples.envs.classes` whose modules can be imported."""
    classes = set()
    for info in pkgutil.walk_packages(examples.__path__, f"{examples.__name__}."):
        try:
            module = importlib.import_module(info.name)
        except ImportError:  # of a package that is not installed
            continue
        for name, value in vars(module).items():
            # Classes that `make_multi_agent` returns have its module.
            is_own = getattr(value, "__module__", "") in (info.name, MultiAgentEnv.__module__)
            if isinstance(value, type) and issubclass(value, MultiAgentEnv) and value is not MultiAgentEnv and is_own:
                classes.add(f"{info.name.removeprefix(examples.__name__ + '.')}:{name}")
    return classes


def test_the_page_lists_all_of_them() -> None:
    assert set(listed()) == shipped()


@pytest.mark.parametrize("name", listed())
def test_each_is_accepted_or_refused_as_listed(name: str) -> None:
    arguments, reason = listed()[name]
    environment = {"entry_point": f"{examples.__name__}.{name}", "kwargs": arguments}
    config = LeagueConfig.from_mapping({"league": "x", "environment": environment})
    # Some toss a coin with these generators, whatever the seed is, and all tosses of a test may be equal.
    random.seed(0)
    np.random.seed(0)
    examination = examine(config, episodes=2)
    faults = [str(finding) for finding in examination.findings if finding.severity == "fault"]
    if reason is None:
        assert faults == []
    else:
        # Another thread of this process may draw from a generator meanwhile, which is then named too.
        parts = reason.split(", and ")
        assert any(all(part in fault for part in parts) for fault in faults), faults
