from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.errors import InterfaceChanged, InvalidReference, LeagueArchived, UnknownLeague
from league.interface import Interface
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Gateway
from league.results.ledger import Ledger
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, config, interface, publish, registered


def test_registering_again_updates_the_configuration_and_keeps_the_versions(registry: Registry) -> None:
    registry.leagues.register(config(), interface(squares=4))
    registry.leagues.register(config(), interface())
    before = registry.leagues.get(LEAGUE)
    version = publish(registry, "run/1")
    with pytest.raises(InterfaceChanged, match=LEAGUE):
        registry.leagues.register(config(), interface(squares=4))
    registry.leagues.register(config(kwargs={"screen_height": 500}), interface())
    after = registry.leagues.get(LEAGUE)
    assert after.config.environment.kwargs == {"screen_height": 500}
    assert after.environment_digest != before.environment_digest
    assert (after.registered_at, after.interface) == (before.registered_at, interface())
    assert registry.versions.all(LEAGUE) == [version]


def with_play(**play: object) -> LeagueConfig:
    return LeagueConfig.from_mapping(config().model_dump(by_alias=True) | {"play": play})


def test_a_change_of_the_game_is_reported_once_it_concerns_results(
    registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    for play in ({"opening_plies": 4}, {"actions": "sampled"}, {}):
        registry.leagues.register(with_play(**play), interface())
    ledger = Ledger(registry)
    ledger.open(SCHEDULE)
    ledger.extend([play_match(SCHEDULE, 0)])
    for play in ({}, {"actions": "greedy"}):  # the default
        registry.leagues.register(with_play(**play), interface())
    assert caplog.messages == []
    for play in ({"opening_plies": 4}, {"actions": "sampled"}, {"opening_plies": 4}):
        registry.leagues.register(with_play(**play), interface())
    game, _, back = caplog.messages
    assert "the game has changed: play.opening_plies 0 → 4. Earlier results can be viewed" in game
    assert "opening_plies 0 → 4; how versions select actions has changed: sampled → greedy. Earlier" in back
    row = registry.leagues.get(LEAGUE)
    assert ledger.counted(LEAGUE, row.conditions) == []
    assert ledger.counted(LEAGUE, SCHEDULE.conditions) == [SCHEDULE]
    assert row.environment_digest == SCHEDULE.environment_digest
    registry.leagues.register(with_play(), interface())
    registry.leagues.register(with_play(actions="sampled"), interface())
    assert "how versions select actions has changed: greedy → sampled. Earlier results can be" in caplog.messages[-1]


def test_a_league_follows_the_code_of_its_environment(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    before = registry.leagues.get(LEAGUE)
    assert registry.leagues.follow_code(LEAGUE, described) == before
    publish(registry, "run/1")
    changed = config(revision="2").game()
    monkeypatch.setattr(LeagueConfig, "game", lambda self: changed)
    with pytest.raises(InterfaceChanged):
        registry.leagues.follow_code(LEAGUE, lambda config: interface(squares=10))
    assert registry.leagues.get(LEAGUE).game_digest == before.game_digest
    after = registry.leagues.follow_code(LEAGUE, described)
    assert after.game_digest == config().game_digest() != before.game_digest
    assert after.config == before.config


def test_an_unknown_league_is_reported_with_the_known_ones(empty: Registry) -> None:
    with pytest.raises(UnknownLeague, match="no league 'chess'; known: none yet"):
        empty.leagues.get("chess")
    registry, moment = registered(empty), datetime.now(UTC)
    by: dict[str, Any] = {"actor": "ada", "reason": "test"}
    for use in (
        lambda: registry.aliases.history("chess"),
        lambda: registry.aliases.set("chess", "champion", 1, expected=None, **by),
        lambda: registry.changes.token("chess"),
        lambda: registry.evaluations.newest("chess"),
        lambda: registry.evaluations.submit("chess", {}, actor="bot", max_active=8),
        lambda: registry.gateways.announce(Gateway("http://127.0.0.1:1", "a", "chess", "training")),
        lambda: registry.keys.create("bot", ["act"], only_leagues=["chess"]),
        lambda: registry.nightly_runs.all("chess"),
        lambda: registry.nightly_runs.open("chess", [1], 0.1),
        lambda: registry.removal.remove_league("chess"),
        lambda: registry.replicas.acknowledgements("chess"),
        lambda: registry.retention.plan("chess", keep=1, before=moment),
        lambda: registry.retention.retire("chess", keep=1, before=moment),
        lambda: registry.runs.begin("chess", "first", algorithm="ppo", settings={}, seed=0, target=1),
        lambda: registry.runs.newest("chess"),
        lambda: registry.snapshots.get("chess", "leaderboard"),
        lambda: registry.snapshots.put("chess", {"leaderboard": []}, mark="a"),
        lambda: registry.strength.of_run("chess", "first"),
        lambda: registry.traffic.set("chess", canary=None, **by),
        lambda: registry.verdicts.all("chess"),
        lambda: registry.verdicts.find("0f3a", "chess"),
        lambda: registry.versions.all("chess"),
        lambda: registry.versions.newest("chess"),
        lambda: registry.versions.set_note(CheckpointRef("chess", 1), "x", actor="ada"),
        lambda: publish(registry, "run/1", league="chess"),
        lambda: Ledger(registry).counted("chess", SCHEDULE.conditions),
        lambda: Ledger(registry).open(replace(SCHEDULE, league="chess")),
        lambda: Ledger(registry).page("chess"),
    ):
        with pytest.raises(UnknownLeague, match=f"no league 'chess'; known: {LEAGUE}"):
            use()


def test_results_count_again_when_the_game_is_back(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    """The message says so, unless there are none, or the selection of actions is another one."""
    ledger = Ledger(registry)
    ledger.open(SCHEDULE)
    ledger.extend([play_match(SCHEDULE, 0)])
    registry.leagues.register(config(revision="2"), interface())
    registry.leagues.register(config(), interface())
    changed, back = caplog.messages
    assert changed.endswith("Earlier results can be viewed, but no longer count in ratings, payoffs and verdicts.")
    assert back.endswith("The results from when the league last had this game count again.")
    assert "Later results can be viewed, but no longer count" in back
    registry.leagues.register(config(revision="2"), interface())
    assert "Earlier results" in caplog.messages[-1], "no games were played with revision 2"
    registry.leagues.register(config(), interface().model_copy(update={"hidden_information": True}))
    assert "Earlier results" in caplog.messages[-1], "sampled games were never played"


def test_a_change_of_the_game_is_described_before_it_is_registered(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert registry.leagues.unregistered_change(LEAGUE) is None
    changed = config(revision="2").game()
    with monkeypatch.context() as patch:
        patch.setattr(LeagueConfig, "game", lambda self: changed)
        assert "the game has changed: " in str(registry.leagues.unregistered_change(LEAGUE))
        patch.setattr(EnvironmentConfig, "has_code", lambda self: False)
        assert registry.leagues.unregistered_change(LEAGUE) is None, "its code is on another machine"
    assert registry.leagues.unregistered_change(LEAGUE) is None


def test_the_action_selections_of_all_leagues_are_read(registry: Registry) -> None:
    registered(registry, "another")
    hidden = interface().model_copy(update={"hidden_information": True})
    registry.leagues.register(config(), hidden)
    rows = [registry.leagues.get(name) for name in registry.leagues.names()]
    assert registry.leagues.action_selections() == {row.slug: row.conditions.actions for row in rows}
    assert registry.leagues.action_selections() == {"another": "greedy", LEAGUE: "sampled"}


def described(_: LeagueConfig) -> Interface:
    return interface()


def test_nothing_is_registered_or_published_in_an_archived_league(registry: Registry) -> None:
    publish(registry, "run/1")
    archived = registry.leagues.archive(LEAGUE)
    assert registry.leagues.archive(LEAGUE).archived_at == archived.archived_at
    assert registry.leagues.names() == {LEAGUE: archived.archived_at}
    for change in (lambda: registry.leagues.register(config(), interface()), lambda: publish(registry, "run/2")):
        with pytest.raises(LeagueArchived, match="tictactoe is archived: `league archive tictactoe --undo`"):
            change()
    assert [version.number for version in registry.versions.all(LEAGUE)] == [1]
    assert registry.leagues.archive(LEAGUE, undo=True).archived_at is None
    registry.leagues.register(config(), interface())
    assert publish(registry, "run/2").number == 2


def test_a_new_league_is_not_named_like_an_option(registry: Registry) -> None:
    with pytest.raises(InvalidReference, match="league '-x' must not begin with '-'"):
        registry.leagues.register(config("-x"), interface())
    assert registry.leagues.names().keys() == {LEAGUE}
    with pytest.raises(InvalidReference, match="alias '-x' must not begin with '-'"):
        registry.aliases.set(LEAGUE, "-x", 1, expected=ANY, actor="test", reason="test")


def test_a_league_is_stored_as_registered(registry: Registry) -> None:
    registered(registry, "another")
    assert list(registry.leagues.names()) == ["another", LEAGUE]
    row = registry.leagues.get(LEAGUE)
    assert (row.config, row.interface, row.interface_digest) == (config(), interface(), interface().digest())
    assert (row.environment_digest, row.game_digest) == (config().environment.digest(), config().game_digest())
