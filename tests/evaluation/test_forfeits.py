"""Who gives no action that can be played forfeits that game, and nothing else changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from evaluation.forfeits import by_rule, forfeits
from evaluation.paired import paired_difference
from evaluation.play import Roster, play
from evaluation.replay import replay
from evaluation.schedule import round_robin
from evaluation.shows import recorded
from evaluation.standings import ranked, standings
from evaluation.tournament import evaluate
from league.environments.lockstep import stepping
from league.errors import EnvironmentMismatch, IllegalMask
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.results.admission import admit
from league.results.documents import dump_games, load_games
from league.results.ledger import Ledger
from league.results.records import Forfeit, Game, Match, Reason, Schedule
from tests.evaluation import examples
from tests.evaluation.test_play import CONFIG, CONTESTANTS, INTERFACE, roster
from tests.evaluation.test_play_kinds import KINDS, Kind

BAD = "tictactoe@9"
COPIES = (1, 2, 5, 32)


@dataclass
class Flawed:
    """A good policy with a flaw: what it answers where `flaw` is true of a row's observation."""

    good: Policy
    flaw: Callable[[Any], bool]
    answer: Callable[[Actions], Actions]

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        answer = self.good.act(observations, state=state, explore=explore, rng=rng)
        rows = [row for row, seen in enumerate(observations["observation"]) if self.flaw(seen)]
        return self.answer(answer, rows) if rows else answer


def raises(answer: Actions, rows: list[int]) -> Actions:
    raise RuntimeError(f"no idea what to do in {len(rows)} of {len(answer.actions)} positions")


def illegal(answer: Actions, rows: list[int]) -> Actions:
    """The square 99."""
    return replace(answer, actions=np.where(np.isin(np.arange(len(answer.actions)), rows), 99, answer.actions))


def floats(answer: Actions, rows: list[int]) -> Actions:
    return replace(answer, actions=answer.actions.astype(np.float32))


def misshapen(answer: Actions, rows: list[int]) -> Actions:
    return replace(answer, actions=answer.actions[:, None])


def too_few(answer: Actions, rows: list[int]) -> Actions:
    return replace(answer, actions=answer.actions[:0])


def nothing(answer: Actions, rows: list[int]) -> Any:
    return None


def five_marks(board: np.ndarray) -> bool:
    return int(board.sum()) >= 5


FLAWS: dict[str, tuple[Any, Reason]] = {
    "illegal": (illegal, "illegal_action"),
    "raises": (raises, "crashed"),
    "floats": (floats, "malformed"),
    "misshapen": (misshapen, "malformed"),
    "too few": (too_few, "malformed"),
    "nothing": (nothing, "crashed"),
}


def flawed(flaw: Any, good: str = "tictactoe@2") -> Policy:
    return Flawed(roster()[good]["player_1"][1], five_marks, flaw)


def with_bad(policy: Policy, ref: str = BAD) -> Roster:
    return {**roster(), ref: dict.fromkeys(INTERFACE.agents, ("shared", policy))}


def played(schedule: Schedule, everybody: Roster, copies: int = 8, positions: Sequence[int] | None = None) -> Any:
    positions = range(schedule.length) if positions is None else positions
    return play(schedule, positions, stepping(CONFIG.environment, copies), INTERFACE, everybody)


def order(*contestants: str, blocks: int = 4) -> Schedule:
    return round_robin(examples.config(play={"opening_plies": 2}), INTERFACE, contestants, blocks)


@pytest.mark.parametrize("name", FLAWS)
def test_only_the_games_in_which_it_cannot_act_are_forfeited(name: str) -> None:
    """Up to there they are the games of the policy without the flaw, and the others are those games entirely."""
    flaw, reason = FLAWS[name]
    schedule = order(*CONTESTANTS, BAD, blocks=6)
    without = played(schedule, with_bad(roster()["tictactoe@2"]["player_1"][1]))
    expected = [
        replace(match, games=tuple(game_with_flaw(match, game, reason) for game in match.games)) for match in without
    ]
    found = played(schedule, with_bad(flawed(flaw)))
    for match, other in zip(found, expected, strict=True):
        for game, like in zip(match.games, other.games, strict=True):
            assert (game.actions, game.forfeits) == (like.actions, like.forfeits), match.id
            assert game == like or game.forfeits
    assert 0 < forfeits(found, BAD) < 2 * 4 * 6
    assert forfeits(found, "tictactoe@1") == 0
    for copies in COPIES:
        assert played(schedule, with_bad(flawed(flaw)), copies) == found


def game_with_flaw(match: Match, game: Game, reason: Reason) -> Game:
    """What the flaw makes of a game of the good policy: it ends where that sees five marks or more on the board."""
    if BAD not in match.contestants:
        return game
    bad = match.contestants.index(BAD)
    for turn in range(len(game.actions)):
        marks = turn + len(game.opening)
        side = marks % 2
        if marks >= 5 and game.sides[side] == bad:
            lost = Forfeit(bad, INTERFACE.sides[f"player_{side + 1}"][0], reason)
            return replace(game, actions=game.actions[:turn], forfeits=(lost,))
    return game


def test_a_forfeited_game_is_lost_whatever_it_had_brought() -> None:
    matches = played(order("script:one_ply", BAD, blocks=20), with_bad(flawed(raises)))
    lost = [(match, game) for match in matches for game in match.games if game.forfeits]
    assert lost
    for match, game in lost:
        bad = match.contestants.index(BAD)
        assert game.forfeited_by(bad)
        assert not game.forfeited_by(1 - bad)
        assert (game.scores[bad], game.scores[1 - bad]) == (0.0, 1.0)
        assert game.returns == (0.0, 0.0)


def test_a_script_that_crashes_forfeits_and_draws_on_as_if_nothing_had_been() -> None:
    """It raises after it has drawn for the whole batch: the others' next draws must not have moved."""
    schedule = order("script:flaky", "script:random", blocks=12)
    everybody = with_bad(flawed(raises, good="script:random"), "script:flaky")
    alone = played(schedule, everybody, copies=1)
    assert 0 < forfeits(alone, "script:flaky") < 24
    for copies in COPIES:
        assert played(schedule, everybody, copies) == alone
    sound = played(schedule, with_bad(roster()["script:random"]["player_1"][1], "script:flaky"))
    pairs = [(a, b) for m, n in zip(alone, sound, strict=True) for a, b in zip(m.games, n.games, strict=True)]
    assert all(a == b for a, b in pairs if not a.forfeits)
    assert all(a.actions == b.actions[: len(a.actions)] for a, b in pairs)


def test_a_policy_that_only_minds_company_forfeits_nothing() -> None:
    """Rows are asked for one by one where a batch fails; whoever can answer each of them loses no game."""

    class Solitary(Flawed):
        def act(self, observations: Arrays, **rest: Any) -> Actions:
            assert len(observations["action_mask"]) == 1, "one at a time, please"
            return self.good.act(observations, **rest)

    good = roster()["tictactoe@2"]["player_1"][1]
    schedule = order("tictactoe@1", BAD)
    solitary = Solitary(good, five_marks, raises)
    assert played(schedule, with_bad(solitary)) == played(schedule, with_bad(good))


def test_the_first_move_can_be_the_one() -> None:
    schedule = replace(order("script:random", BAD, blocks=3), opening_plies=0)
    hopeless = Flawed(roster()["tictactoe@1"]["player_1"][1], lambda board: True, raises)
    for match in played(schedule, with_bad(hopeless)):
        bad = match.contestants.index(BAD)
        assert [game.forfeited_by(bad) for game in match.games] == [True, True]
        assert sorted(len(game.actions) for game in match.games) == [0, 1]
        assert match.score(bad) == 0
        admit(match, schedule)


def test_forfeits_are_kept_admitted_and_replayed_up_to_there() -> None:
    schedule = order("script:one_ply", BAD, blocks=10)
    environment, seen = stepping(CONFIG.environment, 1), 0
    for match in played(schedule, with_bad(flawed(illegal))):
        admit(match, schedule)
        kept = replace(match, games=load_games(dump_games(match.games)))
        assert kept == match
        for index, game in enumerate(kept.games):
            moments = list(replay(environment, CONFIG, INTERFACE, kept, index))
            assert [move.action for moment in moments for move in moment.moves] == [*game.opening, *game.actions]
            assert [moment.is_over for moment in moments] == [False] * (len(moments) - 1) + [True]
            seen += bool(game.forfeits)
    assert seen


def test_rows_from_before_there_were_forfeits_are_read() -> None:
    (game, _) = load_games("[5,[1,2],[[[0,1],[3,4],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,4],[1.0,-1.0],[1.0,0.0]]]]")
    assert game == Game((0, 1), 5, (1, 2), (3, 4), (1.0, -1.0), (1.0, 0.0))
    assert dump_games([game]) == "[5,[1,2],[[[0,1],[3,4],[1.0,-1.0],[1.0,0.0]]]]"


FORGED: dict[str, Callable[[Game, Forfeit], Game]] = {
    "by the other one": lambda game, by: replace(game, forfeits=(replace(by, contestant=1 - by.contestant),)),
    "as the other agent": lambda game, by: replace(
        game, forfeits=(replace(by, agent="player_1" if by.agent == "player_2" else "player_2"),)
    ),
    "as nobody": lambda game, by: replace(game, forfeits=(replace(by, agent="player_3"),)),
    "earlier": lambda game, by: replace(game, actions=game.actions[:-1]),
    "with a return": lambda game, by: replace(game, returns=(1.0, -1.0)),
}


@pytest.mark.parametrize("change", FORGED)
def test_a_forfeit_that_was_not_so_is_found_by_replaying(change: str) -> None:
    matches = played(order("script:one_ply", BAD, blocks=10), with_bad(flawed(raises)))
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    games = list(match.games)
    games[index] = FORGED[change](games[index], games[index].forfeits[0])
    with pytest.raises(EnvironmentMismatch, match="cannot be replayed"):
        list(replay(stepping(CONFIG.environment, 1), CONFIG, INTERFACE, replace(match, games=tuple(games)), index))


def test_an_environment_that_allows_nothing_is_not_a_contestants_fault() -> None:
    environment = stepping(CONFIG.environment, 2)
    start = environment.start

    def nothing_allowed(next_episode: Any) -> Any:
        turn = start(next_episode)
        for batch in turn.batches.values():
            batch.observations["action_mask"][:] = 0
        return turn

    environment.start = nothing_allowed  # type: ignore[method-assign]
    schedule = replace(order("tictactoe@1", "tictactoe@2"), opening_plies=0)
    with pytest.raises(IllegalMask, match="allows no action"):
        play(schedule, [0], environment, INTERFACE, roster())


# -- where agents act at once, and where contestants are compared on the same side --


@dataclass
class Clumsy:
    """Plays on until its `step`-th call of an episode, as told by its memory, and then answers NaN."""

    step: int
    width: int

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        rows = len(observations["observation"])
        taken = np.zeros((rows, 1), np.float32) if state is None else state["state_in_0"]
        actions = np.where(taken == self.step, np.nan, 0.5) * np.ones((rows, self.width))
        return Actions(actions.astype(np.float32), {"state_in_0": taken + 1})


def clumsy(kind: Kind, **steps: int) -> Roster:
    width = 5
    cast = {ref: Clumsy(step, width) for ref, step in steps.items()}
    return {
        f"kind@{ref}": {agent: (name, policy) for agent, name in kind.interface.policies.items()}
        for ref, policy in cast.items()
    }


CONTINUOUS = {"max_cycles": 6, "continuous_actions": True}
FREE = Kind("mpe2.simple_spread_v3", CONTINUOUS, None)
NEVER = 99


def meet(kind: Kind, first: int, second: int, copies: int = 4) -> tuple[Schedule, list[Match]]:
    schedule = kind.schedule(["kind@a", "kind@b"], plies=1)
    environment = stepping(kind.config.environment, copies)
    everybody = clumsy(kind, a=first, b=second)
    return schedule, play(schedule, range(schedule.length), environment, kind.interface, everybody)


def test_who_forfeits_among_many_ends_the_game_of_all() -> None:
    schedule, matches = meet(FREE, 3, NEVER)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert [forfeit.contestant for forfeit in game.forfeits] == [0]
            seat = game.sides.index(0)
            assert game.forfeits[0] == Forfeit(0, f"agent_{seat}", "not_finite")
            assert len(game.actions) == 3 * 3
            assert game.scores == (0.0, 1.0)
    assert meet(FREE, 3, NEVER, copies=1)[1] == matches


def test_who_both_forfeit_at_once_draw() -> None:
    schedule, matches = meet(FREE, 2, 2)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert {forfeit.contestant for forfeit in game.forfeits} == {0, 1}
            assert game.scores == (0.5, 0.5)


@dataclass
class Steady:
    """Always acts alike, in another type of number than the space's."""

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        return Actions(np.full((len(observations["observation"]), 5), 0.1, np.float64))


def test_actions_are_recorded_in_the_policys_own_numbers_whoever_fails_beside_them() -> None:
    """Where a batch fails, rows are asked for alone: which games that happens to must not show."""
    schedule = FREE.schedule(["kind@a", "kind@b"], plies=0, blocks=6)
    cast = {"kind@a": Flawed(Steady(), lambda seen: bool(seen[2] > 0.8), raises), "kind@b": Steady()}
    everybody = {ref: dict.fromkeys(FREE.interface.agents, ("shared", policy)) for ref, policy in cast.items()}

    def meeting(copies: int) -> list[Match]:
        environment = stepping(FREE.config.environment, copies)
        return play(schedule, range(schedule.length), environment, FREE.interface, everybody)

    alone = meeting(1)
    assert 0 < forfeits(alone, "kind@a") < 12
    assert {number for match in alone for game in match.games for action in game.actions for number in action} == {0.1}
    assert meeting(4) == meeting(12) == alone


ALONE = KINDS["continuous team"]
ROLES = Kind(
    "mpe2.simple_adversary_v3",
    CONTINUOUS,
    {"adversary": ["adversary_*"], "good": ["agent_*"]},
    {"adversary": ["adversary_*"], "good": ["agent_*"]},
)


@pytest.mark.parametrize("kind", [ALONE, ROLES], ids=["alone", "roles"])
@pytest.mark.parametrize(
    ("first", "second", "expected"), [(3, NEVER, 0.0), (NEVER, 0, 1.0), (2, 2, 0.5)], ids=["0", "1", "both"]
)
def test_compared_by_side_a_forfeit_loses_the_block(kind: Kind, first: int, second: int, expected: float) -> None:
    schedule, matches = meet(kind, first, second)
    assert schedule.scoring == "side"
    environment = stepping(kind.config.environment, 1)
    for match in matches:
        admit(match, schedule)
        assert (match.score(0), match.score(1)) == (expected, 1 - expected)
        assert by_rule(match, "kind@a") == 2 * expected - 1
        assert by_rule(match, "kind@b") == 1 - 2 * expected
        for index, game in enumerate(match.games):
            assert all(forfeit.reason == "not_finite" for forfeit in game.forfeits)
            last = list(replay(environment, kind.config, kind.interface, match, index))[-1]
            assert last.is_over


def test_what_was_collected_until_then_is_no_return() -> None:
    """Spread costs at every step: whoever breaks off has paid less, and must not look better for it."""
    _, matches = meet(ALONE, 0, NEVER)
    assert all(match.games[0].returns[0] > match.games[1].returns[1] for match in matches)
    assert {match.mean_return(0) for match in matches} == {match.result().returns for match in matches} == {None}
    assert paired_difference(matches, "kind@a") is None
    table = {standing.ref: standing for standing in ranked(match.result() for match in matches)}
    assert (table["kind@a"].mean_return, table["kind@a"].score, table["kind@a"].games) == (None, 0.0, len(matches))
    _, whole = meet(ALONE, NEVER, NEVER)
    assert {by_rule(match, "kind@a") for match in whole} == {None}
    mixed = ranked(match.result() for match in [*matches, *whole])
    assert mixed[0].mean_return == pytest.approx(np.mean([match.mean_return(0) for match in whole]))


# -- versions of a league --


def reckless(crashes: bool) -> bytes:
    """A graph that takes the centre whether it is free or not; or, if it `crashes`, has no answer where it is taken:
    it then looks a number up in a table of one at place 1.
    """
    model = onnx.load_model_from_string(examples.graph(order=examples.CENTRE_FIRST))
    (masking,) = (node for node in model.graph.node if node.op_type == "Where")
    masking.CopyFrom(helper.make_node("Identity", ["wanted"], masking.output))
    if crashes:
        (choosing,) = (node for node in model.graph.node if node.op_type == "ArgMax")
        choosing.output[0] = "centre"
        constants = {"four": np.array(4), "one": np.array(1), "table": np.array([0])}
        model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
        model.graph.node.extend(
            [
                helper.make_node("Gather", ["action_mask", "four"], ["is_free"], axis=1),
                helper.make_node("Cast", ["is_free"], ["free"], to=TensorProto.INT64),
                helper.make_node("Sub", ["one", "free"], ["place"]),
                helper.make_node("Gather", ["table", "place"], ["nothing"]),
                helper.make_node("Add", ["centre", "nothing"], ["action"]),
            ]
        )
    return bytes(model.SerializeToString())


@pytest.mark.parametrize("crashes", [False, True], ids=["illegal", "crashes"])
def test_a_tournament_goes_on_beside_a_version_that_cannot_play(tmp_path: Path, crashes: bool) -> None:
    registry = examples.registry(tmp_path, play={"opening_plies": 2, "copies": 4})
    for graph in (examples.graph(), reckless(crashes)):
        OnnxPolicy(graph)
        examples.publish(registry, graph)
    report = evaluate(examples.LEAGUE, registry=registry, blocks=8)
    matches = Ledger(registry).matches(league=examples.LEAGUE)
    reasons = {forfeit.reason for match in matches for game in match.games for forfeit in game.forfeits}
    assert reasons == {"crashed" if crashes else "illegal_action"}
    assert report.forfeits == {"tictactoe@2": forfeits(matches, "tictactoe@2")}
    assert standings(registry, examples.LEAGUE)[-1].ref == "tictactoe@2"
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    told = ranked(match.result() for match in matches)
    assert {standing.ref: standing.mean_return for standing in told}["tictactoe@1"] is not None
    note = recorded(match.id, index, registry).note
    assert note is not None
    assert note.startswith("forfeited by tictactoe@2 as player_")
