"""What the commands print with `--json`, and their errors, in one home with leagues of all kinds.

`documents` builds the home and runs `COMMANDS` one after the other in this process. stdout stays text, because the
order of keys counts. Placeholders stand for what depends on time, machine or chance.

Left out are commands that need Ray or a server: `nightly --train` and games with workers (slow tests of
`tests/evaluation`), and `act` without `--local` (`tests/cli/serving`); also `doctor`, which describes the machine and
starts Ray (`tests/cli/test_main.py`).
"""

import logging
import re
import shlex
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from string import Template
from typing import Any

import pytest
import yaml

from league.config.environment import EnvironmentConfig
from league.environments.conformance import examination
from league.registry.registry import Registry
from league.registry.replicas import URL
from league.registry.storage.rows import Portion, RunPoint, ShadowCounts
from league.settings import Storage
from tests.support.command import in_process
from tests.support.leagues import match_results, tictactoe
from tests.support.leagues.acknowledgements import read_everything, silence
from tests.support.leagues.served_leagues import build_everything, nested, publish
from tests.support.policies.graphs import masked_mlp

PLAIN = ("export", "note", "void")
"""Commands without `--json` that change or read what others print."""
COMMANDS = """
replicas
replicas --remove alive
replicas --remove silent
replicas --remove other
list
versions tictactoe
versions chess
versions board
versions board --limit 2
versions duo --limit 2
versions empty
versions nested
runs board
runs board --limit 1
runs tictactoe
runs chess
history board
history board --alias candidate
history board --at '2999-01-01 00:00'
history board --at '2020-01-01 00:00'
history board --at noon
history chess
traffic board
traffic memory
traffic chess
keys list
report board
report empty
report tictactoe
report chess
report board --out page.html
compare 20261124 20261125
compare first second
compare board/first exploiter
compare 2026 first
compare first first
compare chess/1 first
verify board-verdict-won
verify board-verdict
verify nothing
exploitability tictactoe@1
exploitability tictactoe@9
mixture tictactoe
mixture empty
mixture tictactoe --method best
rollback tictactoe
rollback chess
promote tictactoe@1
promote tictactoe@1 --expected 2
promote tictactoe@champion --yes
promote tictactoe@9 --yes
promote tictactoe@4 --yes
promote tictactoe --yes
act tictactoe --local
act tictactoe@3 --local
act tictactoe@1 --local --explore --seed 5
act tictactoe@3 --local -o '{"observation": [[1]]}'
act tictactoe@3 --local --policy other
act memory --local -o '[1.5]'
act vector@1 --local -o '[0.5, -0.25]'
act script:random
check-env tictactoe.yaml
check-env team.yaml
check-env broken.yaml
check-env nowhere.yaml
evaluate tictactoe --blocks 4 --workers 0
evaluate tictactoe --schedule gauntlet tictactoe@3 --against tictactoe@1 --blocks 3 --workers 0
evaluate tictactoe --schedule adaptive --games 20 --workers 0
evaluate team.yaml script:random script:first --blocks 2 --workers 0
evaluate team.yaml script:random script:first --schedule cross_play --blocks 2 --workers 0
evaluate tictactoe --schedule cross_play --workers 0
evaluate tictactoe --against tictactoe@1 --workers 0
evaluate tictactoe board@1 --workers 0
evaluate chess --workers 0
exploitability tictactoe@2 --blocks 4 --workers 0
exploitability tictactoe@2 --exploiter tictactoe@2 --workers 0
nightly tictactoe --workers 0
nightly tictactoe --workers 0
nightly headless broken.yaml nowhere.yaml chess --workers 0
list
versions tictactoe
history tictactoe
report tictactoe
compare 20261124 20261125
verify $verdict
verify $verdict --replays 2
recount tictactoe
recount board
recount chess
note tictactoe@2 'half the entropy bonus'
note tictactoe@9 lost
search tictactoe@5 --simulations 4 --note 'looks ahead'
search tictactoe@5 --simulations 4
search tictactoe@1
act tictactoe@6 --local --analysis --seed 3
mixture tictactoe
mixture tictactoe --method alpha_rank
mixture tictactoe --at-least 0.5 --method alpha_rank
mixture tictactoe --alias mix
mixture tictactoe --method alpha_rank --at-least 0 --alias mix --yes --reason balanced --actor bob
promote tictactoe@1:0.75,@3:0.25 --yes --alias candidate
promote tictactoe@1:0.75,@3:0.25 --yes --expected none
promote tictactoe@1:0.75,@3:0.2 --yes
promote tictactoe@candidate --yes --reason 'an experiment' --actor bob
promote tictactoe@candidate
promote tictactoe@2 --yes --wait --timeout 0
promote tictactoe@2 --yes --wait
promote tictactoe@2 --alias 12
rollback tictactoe --expected 1
rollback tictactoe
rollback tictactoe
history tictactoe
history tictactoe --alias candidate
traffic tictactoe --canary candidate --shadow 3 --shadow-share 0.5
traffic tictactoe --share 0.2 --actor bob --reason careful
traffic tictactoe
traffic tictactoe --canary none
traffic tictactoe --canary 3 --wait --timeout 0
traffic tictactoe --canary 3 --wait
traffic tictactoe --off
traffic tictactoe --off --canary 3
traffic tictactoe --canary 99
traffic tictactoe --shadow champion
traffic memory --share 0.2
keys create duo --scope promote --scope act --league tictactoe --rate 600/m
keys create forever --scope read --expires 30d
keys create lobby --scope act
keys create other --scope fly
keys create other --scope act --rate fast
keys create other --scope act --league chess
keys revoke duo
keys revoke nobody
keys list
void $verdict --reason 'a broken machine' --actor bob
verify $verdict
retire nested --keep 1 --days 0
retire nested --keep 1 --days 0 --dry-run
retire nested tictactoe --keep 1 --days 0 --yes
retire --keep 2 --days 0 --yes
retire chess --yes
versions nested
promote nested@2 --yes
act nested@2 --local -o '{"mode": 1, "sense": {"speed": [0.5, -2.0]}}'
export nested@2
archive vector
archive vector --undo
archive memory
archive board
archive chess
remove tictactoe@2 --dry-run
remove tictactoe@2 --yes
remove tictactoe@7 --yes
remove tictactoe@7 --yes --force
remove tictactoe@2 --yes --force
remove nested@3
remove nested@3 --yes
remove duo --dry-run
remove duo --yes
remove duo --yes --force
remove duo --yes
remove board --yes --force
list
versions tictactoe
"""
"""In this order. `$verdict` is the first one of tic-tac-toe."""
RUNS = {"20261124-080000-aa12bc": 0.001, "20261125-080000-de34f5": 0.0005}
"""Training runs of tic-tac-toe, and their learning rates."""
FILES = {
    "tictactoe": tictactoe.config().model_dump(mode="json", by_alias=True),
    "team": {
        "league": "team",
        "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 5}},
        "sides": {"team": ["*"]},
    },
    "broken": {"league": "broken", "environment": {"entry_point": "nowhere.to_be_found"}},
}
"""Configurations in the working directory."""
CHANGING = {
    r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)": "<time>",
    r"plk_[0-9a-f]{8}_[0-9a-f]{64}": "<token>",
    r'"id": "[0-9a-f]{8}"': '"id": "<key>"',
    r'"seconds": [0-9]+\.[0-9]{6,}': '"seconds": "<measured>"',  # those of training runs are round
    r'"(silent_seconds|steps_per_second|stock_steps_per_second|ms)": [0-9.]+': r'"\1": "<measured>"',
    r"reported \d+ s ago": "reported <measured> s ago",
    r"searched: .*?, installed packages": "searched: <folders>, installed packages",  # those of earlier tests, too
}
"""Regular expression → what stands for its matches."""
SHA256 = re.compile(r'(?<="sha256": ")[0-9a-f]{64}(?=")')
"""Digest of a version, whose manifest has a time. Equal ones have the same placeholder."""


def documents() -> Iterator[tuple[str, Any]]:
    """Yield (case, document) for each command, which is `{"exit_code", "stdout", "stderr"}`."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setenv("LOGNAME", "ada")  # who acts
        # Otherwise the ids and the games of schedules depend on the versions of libraries.
        patched.setattr(EnvironmentConfig, "code", lambda _: {"environment.source": "recorded"})
        patched.setattr(examination, "COMPARED_STEPS", 500)
        patched.setattr(examination, "MEASURED_SECONDS", 0.01)
        patched.setattr("evaluation.matches.leaderboard.MAX_UPSETS", 1)  # whose pictures take most of the time
        home = Path(folder) / "home"
        logging.disable()  # records on stderr name time and process
        try:
            with closing(_build(home)) as registry:
                yield from _printed(registry, folder)
        finally:
            logging.disable(logging.NOTSET)


def _printed(registry: Registry, folder: str) -> Iterator[tuple[str, Any]]:
    """Run the commands in the folder that contains the home and the configurations."""
    numbers, digests = Counter[str](), dict[str, str]()

    def stable(text: str) -> str:
        text = text.replace(folder, "<folder>")
        for pattern, placeholder in CHANGING.items():
            text = re.sub(pattern, placeholder, text)
        return SHA256.sub(lambda match: digests.setdefault(match[0], f"<sha256 {len(digests) + 1}>"), text)

    for command in filter(None, COMMANDS.splitlines()):
        verdicts = registry.verdicts.all(tictactoe.LEAGUE)
        arguments = shlex.split(Template(command).substitute(verdict=verdicts[0].id if verdicts else ""))
        read_everything(registry, "alive")  # which `--wait` waits for: it serves what the last command left
        result = in_process(registry.storage.home, *arguments, *([] if arguments[0] in PLAIN else ["--json"]))
        numbers[command] += 1
        case = command if numbers[command] == 1 else f"{command} ({numbers[command]})"
        yield case, {"exit_code": result.code, "stdout": stable(result.out), "stderr": stable(result.err)}


def _build(home: Path) -> Registry:
    """A home with leagues of each kind of space, of which `board` has handwritten results, and tic-tac-toe to play."""
    for name, document in FILES.items():
        Path(f"{name}.yaml").write_text(yaml.safe_dump(document))
    registry = build_everything(Storage.at(home))
    match_results.record(registry)
    registry.aliases.set("board", "candidate", 3, expected=None, actor="ada", reason="to be tested")
    registry.traffic.set("board", canary=Portion("candidate", 0.1), shadow=Portion(3, 0.5), actor="ada", reason="new")
    for number in (2, 3):
        publish(registry, "nested", {"shared": nested()}, f"run/{number}")
    registry.leagues.archive("headless")
    registry.keys.create("revoked", ["act", "read"], only_leagues=["duo", "board"], rate=2.5)
    registry.keys.revoke("revoked")
    registry.replicas.register("alive", {URL: "http://127.0.0.1:30001"})
    registry.replicas.register("silent", {})
    latency = [0] * 4 + [90, 10] + [0] * 14
    counts = ShadowCounts("board", 3, 2, 100, 120, 90, failed=3, dropped=2, skipped=1, latency=latency, ns=10**7)
    registry.replicas.write_report("alive", {}, [counts])
    silence(registry, "silent", timedelta(hours=1))
    (home / "logs").mkdir()
    (home / "logs" / "access-former.jsonl").write_text("{}\n")
    _build_tictactoe(registry)
    return registry


def _build_tictactoe(registry: Registry) -> None:
    """Two versions of training runs, a strong one, an exploiter, and one that can search."""
    tictactoe.registry(registry.storage.home).close()
    graphs = tictactoe.graph(), tictactoe.graph(wins=True)
    for (run, lr), graph in zip(RUNS.items(), graphs, strict=True):
        settings = {"lr": lr, "gamma": 0.99}
        registry.runs.begin(tictactoe.LEAGUE, run, algorithm="ppo", settings=settings, seed=1, target=9000)
        metrics = {"shared/return": lr, "shared/entropy": 1.5}
        point = RunPoint(tictactoe.LEAGUE, run, 6000, metrics, registry.runs.get(tictactoe.LEAGUE, run).began_at)
        registry.runs.record(tictactoe.LEAGUE, run, point, seconds=120.0)
        tictactoe.publish(registry, graph, source=f"{run}/6000", settings=settings)
        registry.runs.end(tictactoe.LEAGUE, run, "stopped")
    tictactoe.publish(registry, tictactoe.graph(wins=True, blocks=True))
    tictactoe.publish(registry, tictactoe.graph(blocks=True), exploits="tictactoe@2")
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=value)
