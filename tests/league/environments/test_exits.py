"""An environment that ends the program, as games do when their window closes, raises an exception like any other."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from ray._private.worker import raise_sys_exit_with_custom_error_message

from league.config.league import LeagueConfig
from league.entry_points import import_module
from league.environments.building import build
from league.environments.conformance.examination import examine
from league.environments.copies import StockCopies
from league.environments.lockstep import Lockstep
from league.environments.stepping import each_agent_alone
from league.errors import ConfigError, ExitCalled, no_exit, raised_at
from tests.support.environments.simultaneous import Simultaneous

pytestmark = pytest.mark.usefixtures("short_examinations")


class Exiting(Simultaneous):
    """Ends the program in one of its methods."""

    def __init__(self, where: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.where = where
        self._end("constructor")

    def action_space(self, agent: str) -> spaces.Space:
        self._end("space")
        return super().action_space(agent)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self._end("reset")
        return super().reset(seed, options)

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        self._end("step")
        return super().step(actions)

    def close(self) -> None:
        self._end("close")

    def _end(self, where: str) -> None:
        if where == self.where:
            sys.exit(0)


class ExitingWrapper:
    def __init__(self, env: Simultaneous) -> None:
        exit(1)


def config(where: str, **environment: Any) -> LeagueConfig:
    environment = {"entry_point": f"{__name__}:Exiting", "kwargs": {"where": where}} | environment
    return LeagueConfig.from_mapping({"league": "x", "environment": environment})


def test_what_else_ends_a_process_does_so() -> None:
    with pytest.raises(SystemExit), no_exit:
        raise_sys_exit_with_custom_error_message("The process receives a SIGTERM.", exit_code=1)
    with pytest.raises(KeyboardInterrupt), no_exit:
        raise KeyboardInterrupt
    with pytest.raises(ExitCalled, match=r"^sys\.exit\(\) was called$") as exited, no_exit:
        sys.exit()
    assert str(raised_at(exited.value)).startswith(__file__)


def test_an_examination_names_the_line(subtests: pytest.Subtests) -> None:
    lines = Path(__file__).read_text().splitlines()
    line = next(number for number, text in enumerate(lines, 1) if "sys.exit(0)" in text)
    place = f"{__file__}, line {line}"
    for where, problem in (
        ("constructor", f"{__name__}:Exiting cannot be created ({place})"),
        ("space", f"{__name__}:Exiting: the spaces of agent_0 cannot be read ({place})"),
        ("reset", f"the environment raised an exception ({place}, reset with seed 0)"),
        ("step", f"the environment raised an exception ({place}, step 1 of the episode with seed 0)"),
    ):
        with subtests.test(where=where):
            (fault,) = (finding for finding in examine(config(where)).findings if finding.severity == "fault")
            assert f"{problem}: ExitCalled: sys.exit(0) was called" in str(fault)


def test_an_exit_in_close_is_a_note_beside_other_findings() -> None:
    league = config("close", kwargs={"where": "close", "bad_reward": float("nan")})
    reward, *_, close = examine(league).findings
    assert "got a reward of nan" in str(reward)
    assert close.severity == "note"
    assert re.search(r"^`close` raised .*test_exits.py, line \d+\): ExitCalled: sys.exit\(0\) was called$", str(close))


def test_what_exits_cannot_be_created_or_imported(tmp_path: Path) -> None:
    league = config("nowhere", wrappers=[{"name": f"{__name__}:ExitingWrapper"}])
    with pytest.raises(ConfigError, match=r"cannot be created \(.*\): ExitCalled: sys\.exit\(1\) was called"):
        build(league.environment)
    (tmp_path / "exits_on_import.py").write_text("import sys\nsys.exit('no display')\n")
    message = r"fails on import: ExitCalled: sys\.exit\('no display'\) was called \(.*exits_on_import\.py, line 2\)"
    with pytest.raises(ConfigError, match=message):
        import_module("environment.entry_point", "exits_on_import", str(tmp_path))
    stepping = Lockstep(StockCopies(lambda: Exiting("step"), 1, 1))
    turn = stepping.start(each_agent_alone([5], 2))
    crashed = stepping.step({group: np.zeros(len(batch), np.int64) for group, batch in turn.batches.items()}).crashed
    assert crashed.tolist() == [0], "its episode has crashed"
