"""Any sequence of changes leaves the registry as a plain model of it, whatever the database."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from league.errors import (
    AliasMoved,
    Conflict,
    LeagueError,
    NothingToRollBack,
    TooManyEvaluations,
    UnknownAlias,
    UnknownVerdict,
    UnknownVersion,
    VersionRetired,
)
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.evaluations import MAX_ATTEMPTS
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.results.ledger import Ledger
from tests.support.databases import on_both_databases
from tests.support.examples import examples
from tests.support.leagues.ledger_matches import SCHEDULE
from tests.support.leagues.registries import LEAGUE, leftovers, publish, registered, traffic_history

pytestmark = on_both_databases

VERSIONS = st.integers(0, 7)
"""Which of the versions, or one that does not exist."""
ALIASES = st.sampled_from(["champion", "candidate"])
VERDICTS = st.sampled_from(["verdict-a", "verdict-b"])
RUNNERS = st.sampled_from(["one", "one", "two"])


@dataclass
class Evaluation:
    state: str = "queued"
    runner: str = ""
    attempts: int = 0
    is_stopping: bool = False

    def is_held_by(self, runner: str) -> bool:
        return (self.state, self.runner) == ("running", runner)

    def lose(self) -> None:
        """Its runner is gone."""
        self.state = "stopped" if self.is_stopping else "failed" if self.attempts >= MAX_ATTEMPTS else "queued"


@dataclass
class Model:
    """parents: version → the one that it was trained from. events: (alias, kind, version, previous). stack: the
    champions to which rollbacks return. verdicts: id → candidate. applied: verdicts that promoted a version.
    """

    published: int = 0
    parents: dict[int, int | None] = field(default_factory=dict)
    retired: set[int] = field(default_factory=set)
    aliases: dict[str, int] = field(default_factory=dict)
    events: list[tuple[str, str, int, int | None]] = field(default_factory=list)
    stack: list[int] = field(default_factory=list)
    settings: list[dict[str, Portion | None]] = field(default_factory=list)
    verdicts: dict[str, int] = field(default_factory=dict)
    outcomes: dict[str, str] = field(default_factory=dict)
    applied: set[str] = field(default_factory=set)
    evaluations: dict[int, Evaluation] = field(default_factory=dict)

    @property
    def traffic(self) -> dict[str, Portion | None]:
        return self.settings[-1] if self.settings else {"canary": None, "shadow": None}

    def unusable(self, version: int) -> type[LeagueError] | None:
        return UnknownVersion if version not in self.parents else VersionRetired if version in self.retired else None

    def active(self) -> list[Evaluation]:
        return [evaluation for evaluation in self.evaluations.values() if evaluation.state in ("queued", "running")]

    def portions_of(self, version: int) -> list[str]:
        names = {version, *(alias for alias, target in self.aliases.items() if target == version)}
        return [name for name, portion in self.traffic.items() if portion and portion.version in names]

    def is_used(self, version: int) -> bool:
        targets = {*self.aliases.values(), *self.parents.values(), *self.verdicts.values()}
        return version in targets or bool(self.portions_of(version))

    def remove(self, version: int) -> None:
        """Remove a version, and what depends on it."""
        if ended := self.portions_of(version):
            self.settings.append(self.traffic | dict.fromkeys(ended))
        if self.aliases.get("champion") == version:
            self.stack = []
        self.stack = [champion for champion in self.stack if champion != version]
        self.aliases = {alias: target for alias, target in self.aliases.items() if target != version}
        self.events = [event for event in self.events if event[2] != version]
        self.parents = {
            number: None if parent == version else parent
            for number, parent in self.parents.items()
            if number != version
        }
        self.verdicts = {verdict: target for verdict, target in self.verdicts.items() if target != version}
        self.outcomes = {verdict: outcome for verdict, outcome in self.outcomes.items() if verdict in self.verdicts}
        self.applied &= self.verdicts.keys()
        self.retired.discard(version)

    def retire(self, keep: int) -> set[int]:
        """The versions that lose their files now."""
        old = sorted(self.parents.keys() - self.retired, reverse=True)[keep:]
        needed = {version for _, _, version, _ in self.events} | set(self.verdicts.values())
        needed |= {portion.version for portion in self.traffic.values() if portion and portion.version != "candidate"}
        self.retired |= (retired := set(old) - needed)
        return retired


class Changes(RuleBasedStateMachine):
    """Makes each change in the registry and in the model."""

    def __init__(self, registry: Registry) -> None:
        super().__init__()
        self.registry, self.model, self.steps = registered(registry), Model(), 0
        for _ in range(3):
            self.publish_version(None)

    def version(self, number: int) -> int:
        versions = [*self.model.parents, 99]
        return versions[number % len(versions)]

    def publish_version(self, parent: int | None) -> None:
        self.model.published += 1
        assert publish(self.registry, f"run/{self.model.published}", parent=parent).number == self.model.published
        self.model.parents[self.model.published] = parent

    def change(self, act: Callable[[], Any], *refusals: type[LeagueError] | None) -> Any:
        """The result of `act`, or None if it was refused by the first of `refusals`."""
        if (refusal := next(filter(None, refusals), None)) is None:
            return act()
        with pytest.raises(refusal):
            act()
        return None

    @rule(number=VERSIONS)
    def publish(self, number: int) -> None:
        parent = self.version(number)
        self.publish_version(parent if parent in self.model.parents else None)

    @rule(alias=ALIASES, number=VERSIONS, expects=st.sampled_from(["any", "its version", "another"]), verdict=VERDICTS)
    def set_alias(self, alias: str, number: int, expects: str, verdict: str | None) -> None:
        version, at = self.version(number), self.model.aliases.get(alias)
        expected = {"any": ANY, "its version": at, "another": None if at else 1}[expects]
        verdict = verdict if verdict in self.model.verdicts else None
        event = self.change(
            lambda: self.registry.aliases.set(
                LEAGUE, alias, version, expected=expected, actor="ann", reason="better", verdict=verdict
            ),
            Conflict if verdict in self.model.outcomes else None,
            self.model.unusable(version),
            AliasMoved if expected not in (ANY, at) else None,
        )
        if event is None or at == version:
            return
        assert (event.kind, event.version, event.previous, event.verdict) == ("set", version, at, verdict)
        self.model.aliases[alias] = version
        self.model.events.append((alias, "set", version, at))
        self.model.applied |= {verdict} if verdict else set()
        if alias == "champion":
            self.model.stack = [*self.model.stack, version] if at else [version]

    @rule(number=VERSIONS)
    def promote(self, number: int) -> None:
        self.set_alias("champion", number, "its version", "")

    @precondition(lambda self: self.model.stack)
    @rule()
    def roll_back(self) -> None:
        refusal = NothingToRollBack if len(self.model.stack) < 2 else None
        event = self.change(lambda: self.registry.aliases.rollback(LEAGUE, actor="bob", reason="it loses"), refusal)
        if event is not None:
            previous = self.model.stack.pop()
            assert event.version == self.model.stack[-1]
            self.model.aliases["champion"] = event.version
            self.model.events.append(("champion", "rollback", event.version, previous))

    @rule(name=st.sampled_from(["canary", "shadow"]), which=VERSIONS | st.sampled_from(["candidate", None]))
    def set_traffic(self, name: str, which: int | str | None) -> None:
        version = self.version(which) if isinstance(which, int) else which
        portion = None if version is None else Portion(version, 0.5)
        number = self.model.aliases.get(version, 0) if isinstance(version, str) else version
        setting = self.change(
            lambda: self.registry.traffic.set(LEAGUE, **{name: portion}, actor="ada", reason="test"),
            UnknownAlias if number == 0 else None,
            None if number is None else self.model.unusable(number),
        )
        if setting is not None and (not self.model.settings or self.model.traffic[name] != portion):
            self.model.settings.append(self.model.traffic | {name: portion})

    @rule(verdict=VERDICTS, number=VERSIONS)
    def open_verdict(self, verdict: str, number: int) -> None:
        version = self.version(number)
        row = self.change(
            lambda: self.registry.verdicts.open(LEAGUE, version, "script:random", verdict, {}),
            UnknownVersion if version not in self.model.parents else None,
            Conflict if self.model.verdicts.get(verdict, version) != version else None,
        )
        if row is not None:
            contestants = (f"{LEAGUE}@{version}", "script:random")
            Ledger(self.registry).open(replace(SCHEDULE, id=verdict, contestants=contestants))
            self.model.verdicts[verdict] = version

    @rule(verdict=VERDICTS, outcome=st.sampled_from(["promote", "reject"]))
    def close_verdict(self, verdict: str, outcome: str) -> None:
        is_open, is_other = verdict in self.model.verdicts, self.model.outcomes.get(verdict, outcome) != outcome
        refusals = (None if is_open else UnknownVerdict, Conflict if is_other else None)
        self.change(lambda: self.registry.verdicts.close(verdict, outcome, {}), *refusals)
        if is_open:
            self.model.outcomes.setdefault(verdict, outcome)

    @rule(verdict=VERDICTS)
    def void_verdict(self, verdict: str) -> None:
        is_applied = verdict in self.model.applied - self.model.outcomes.keys()
        refusals = (None if verdict in self.model.verdicts else UnknownVerdict, Conflict if is_applied else None)
        if self.change(lambda: self.registry.verdicts.void(verdict, "by mistake"), *refusals) is not None:
            self.model.outcomes[verdict] = "void"

    @rule(number=VERSIONS, force=st.booleans())
    def remove(self, number: int, force: bool) -> None:
        version = self.version(number)
        is_refused = self.model.active() or (self.model.is_used(version) and not force)
        self.change(
            lambda: self.registry.removal.remove_version(CheckpointRef(LEAGUE, version), force=force),
            UnknownVersion if version not in self.model.parents else None,
            Conflict if is_refused else None,
        )
        if version in self.model.parents and not is_refused:
            self.model.remove(version)
            assert leftovers(self.registry) == []

    @rule(keep=st.integers(0, 2))
    def retire(self, keep: int) -> None:
        retired = self.model.retire(keep)
        assert set(self.registry.retention.retire(LEAGUE, keep=keep, before=datetime.now(UTC)).versions) == retired

    @rule()
    def submit(self) -> None:
        row = self.change(
            lambda: self.registry.evaluations.submit(LEAGUE, {}, actor="bot", max_active=2),
            TooManyEvaluations if len(self.model.active()) == 2 else None,
        )
        if row is not None:
            self.model.evaluations[row.id] = Evaluation()

    @rule(runner=RUNNERS)
    def claim(self, runner: str) -> None:
        queued = [number for number, evaluation in self.model.evaluations.items() if evaluation.state == "queued"]
        row = self.registry.evaluations.claim(runner, workers=1)
        assert (row and row.id) == (queued[0] if queued else None)
        if row is not None:
            evaluation = self.model.evaluations[row.id]
            evaluation.state, evaluation.runner, evaluation.attempts = "running", runner, evaluation.attempts + 1

    @precondition(lambda self: self.model.active())
    @rule(act=st.sampled_from(["stop", "release", "finish", "heartbeat"]), runner=RUNNERS, data=st.data())
    def continue_evaluation(self, act: str, runner: str, data: st.DataObject) -> None:
        number = data.draw(st.sampled_from(sorted(self.model.evaluations)))
        evaluation, evaluations = self.model.evaluations[number], self.registry.evaluations
        if act == "stop":
            evaluations.stop(LEAGUE, number, actor="ada")
            evaluation.is_stopping |= evaluation.state in ("queued", "running")
            evaluation.state = "stopped" if evaluation.state == "queued" else evaluation.state
        elif act == "release":
            evaluations.release(number, runner)
            if evaluation.is_held_by(runner):
                evaluation.lose()
        elif act == "finish":
            evaluations.finish(number, runner, "done", result={})
            evaluation.state = "done" if evaluation.is_held_by(runner) else evaluation.state
        else:
            row = evaluations.heartbeat(number, runner)
            assert (row.state, row.runner or "") == (evaluation.state, evaluation.runner)

    @invariant()
    def compare_often(self) -> None:
        self.steps += 1
        if self.steps % 10 == 0:
            self.compare()

    def compare(self) -> None:
        """The registry is as the model."""
        assert self.registry.aliases.current(LEAGUE) == self.model.aliases
        for alias in ("champion", "candidate"):
            history = self.registry.aliases.history(LEAGUE, alias)[::-1]
            recorded = [(event.alias, event.kind, event.version, event.previous) for event in history]
            assert recorded == [event for event in self.model.events if event[0] == alias]
            assert all(earlier.at <= later.at for earlier, later in pairwise(history))
        history_of_traffic = traffic_history(self.registry)[::-1]
        assert [{"canary": row.canary, "shadow": row.shadow} for row in history_of_traffic] == self.model.settings
        current = self.registry.traffic.current(LEAGUE)
        assert {"canary": current.canary, "shadow": current.shadow} == self.model.traffic

        rows = self.registry.versions.all(LEAGUE)
        assert [row.number for row in rows] == list(self.model.parents)
        assert {row.number for row in rows if row.retired_at} == self.model.retired
        assert {alias: row.number for row in rows for alias in row.aliases} == self.model.aliases
        usable = sorted(self.model.parents.keys() - self.model.retired)
        assert self.registry.versions.numbers(LEAGUE) == ({LEAGUE: usable} if usable else {})
        verdicts = {row.id: (row.candidate, row.outcome) for row in self.registry.verdicts.all(LEAGUE)}
        assert verdicts == {
            verdict: (version, self.model.outcomes.get(verdict)) for verdict, version in self.model.verdicts.items()
        }
        states = {row.id: row.state for row in self.registry.evaluations.newest(LEAGUE, limit=100)[::-1]}
        expected = {number: evaluation.state for number, evaluation in self.model.evaluations.items()}
        assert list(states.items()) == list(expected.items())

    def teardown(self) -> None:
        """A removed league leaves nothing, so that the next sequence begins with version 1."""
        self.compare()
        for number, evaluation in self.model.evaluations.items():
            self.registry.evaluations.stop(LEAGUE, number, actor="ada")
            self.registry.evaluations.release(number, evaluation.runner)
        self.registry.removal.remove_league(LEAGUE, force=True)
        assert self.registry.leagues.names() == {}


def test_any_sequence_of_changes_leaves_the_registry_as_its_model(empty: Registry) -> None:
    # A sequence is not shortened, which takes minutes.
    bounds = settings(examples(8), stateful_step_count=120, phases=[Phase.generate])
    run_state_machine_as_test(lambda: Changes(empty), settings=bounds)
