"""A policy without a valid action forfeits that game; all other games are unaffected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.matches.game_records import forfeit_difference, forfeits
from evaluation.matches.leaderboard import compute_leaderboard, rank_contestants
from evaluation.matches.seating import Roster
from evaluation.matches.tournament import evaluate
from evaluation.playback.replay import recorded_game, replay
from evaluation.schedules.builders import round_robin
from evaluation.statistics.payoff import paired_difference
from league.environments.lockstep import stock_stepping
from league.errors import EnvironmentMismatch, IllegalMask
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.results.ledger import Ledger
from league.results.records import Forfeit, Game, Match, Reason, Schedule, dump_games, load_games
from league.results.scoring import admit
from league.results.sums import tally, whole
from tests.support.environments.kinds import KINDS, Kind
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.leagues import tictactoe
from tests.support.policies.illegal_action_graph import illegal_action_graph

BAD = "tictactoe@9"
NUM_ENVS = (1, 5, 32)


@dataclass
class Faulty:
    """A policy with a fault: it changes the answer for rows where `flaw` is true."""

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
        rows = [row for row, observation in enumerate(observations["observation"]) if self.flaw(observation)]
        return self.answer(answer, rows) if rows else answer


def raises(answer: Actions, rows: list[int]) -> Actions:
    raise RuntimeError(f"no idea what to do in {len(rows)} of {len(answer.actions)} positions")


def illegal(answer: Actions, rows: list[int]) -> Actions:
    """Plays the square 99."""
    return replace(answer, actions=np.where(np.isin(np.arange(len(answer.actions)), rows), 99, answer.actions))


def floats(answer: Actions, rows: list[int]) -> Actions:
    return replace(answer, actions=answer.actions.astype(np.float32))


def wrong_shape(answer: Actions, rows: list[int]) -> Actions:
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
    "misshapen": (wrong_shape, "malformed"),
    "too few": (too_few, "malformed"),
    "nothing": (nothing, "crashed"),
}


def faulty(flaw: Any, good: str = "tictactoe@2") -> Policy:
    return Faulty(build_roster()[good]["player_1"][1], five_marks, flaw)


def with_faulty(policy: Policy, ref: str = BAD) -> Roster:
    return {**build_roster(), ref: dict.fromkeys(INTERFACE.agents, ("shared", policy))}


def play(schedule: Schedule, rosters: Roster, num_envs: int = 8, positions: Sequence[int] | None = None) -> Any:
    positions = range(schedule.length) if positions is None else positions
    return play_matches(schedule, positions, stock_stepping(CONFIG.environment, num_envs), INTERFACE, rosters)


def schedule_of(*contestants: str, blocks: int = 4) -> Schedule:
    return round_robin(tictactoe.config(play={"opening_plies": 2}), INTERFACE, contestants, blocks)


@pytest.mark.parametrize("name", FLAWS)
def test_only_games_without_a_valid_action_are_forfeited(name: str) -> None:
    """Until then the games equal those of the policy without the fault, and all other games are identical."""
    flaw, reason = FLAWS[name]
    schedule = schedule_of(*CONTESTANTS, BAD, blocks=6)
    faultless = play(schedule, with_faulty(build_roster()["tictactoe@2"]["player_1"][1]))
    expected = [
        replace(match, games=tuple(game_with_fault(match, game, reason) for game in match.games)) for match in faultless
    ]
    found = play(schedule, with_faulty(faulty(flaw)))
    for match, other in zip(found, expected, strict=True):
        for game, like in zip(match.games, other.games, strict=True):
            assert (game.actions, game.forfeits) == (like.actions, like.forfeits), match.id
            assert game == like or game.forfeits
    assert 0 < forfeits(found, BAD) < 2 * 4 * 6
    assert forfeits(found, "tictactoe@1") == 0
    for num_envs in NUM_ENVS:
        assert play(schedule, with_faulty(faulty(flaw)), num_envs) == found


def game_with_fault(match: Match, game: Game, reason: Reason) -> Game:
    """A game of the faultless policy with the fault: it ends in the turn where that sees five or more marks."""
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


def test_a_forfeited_game_is_lost_whatever_the_return() -> None:
    matches = play(schedule_of("script:one_ply", BAD, blocks=20), with_faulty(faulty(raises)))
    lost = [(match, game) for match in matches for game in match.games if game.forfeits]
    assert lost
    for match, game in lost:
        faulty_index = match.contestants.index(BAD)
        assert {forfeit.contestant for forfeit in game.forfeits} == {faulty_index}
        assert (game.scores[faulty_index], game.scores[1 - faulty_index]) == (0.0, 1.0)
        assert game.returns == (0.0, 0.0)


def test_a_crashing_script_forfeits_without_affecting_the_draws_of_others() -> None:
    """It raises after drawing for the whole batch, which must not change the next draws of others."""
    schedule = schedule_of("script:flaky", "script:random", blocks=12)
    rosters = with_faulty(faulty(raises, good="script:random"), "script:flaky")
    sequential = play(schedule, rosters, num_envs=1)
    assert 0 < forfeits(sequential, "script:flaky") < 24
    for num_envs in NUM_ENVS:
        assert play(schedule, rosters, num_envs) == sequential
    sound = play(schedule, with_faulty(build_roster()["script:random"]["player_1"][1], "script:flaky"))
    pairs = [(a, b) for m, n in zip(sequential, sound, strict=True) for a, b in zip(m.games, n.games, strict=True)]
    assert all(a == b for a, b in pairs if not a.forfeits)
    assert all(a.actions == b.actions[: len(a.actions)] for a, b in pairs)


def test_a_policy_that_fails_only_in_batches_forfeits_nothing() -> None:
    """If a batch fails, each row is evaluated alone."""

    class UnbatchedOnly(Faulty):
        def act(self, observations: Arrays, **rest: Any) -> Actions:
            assert len(observations["action_mask"]) == 1, "one row at a time"
            return self.good.act(observations, **rest)

    good = build_roster()["tictactoe@2"]["player_1"][1]
    schedule = schedule_of("tictactoe@1", BAD)
    solitary = UnbatchedOnly(good, five_marks, raises)
    assert play(schedule, with_faulty(solitary)) == play(schedule, with_faulty(good))


def test_the_first_move_can_be_forfeited() -> None:
    schedule = replace(schedule_of("script:random", BAD, blocks=3), opening_plies=0)
    always_failing = Faulty(build_roster()["tictactoe@1"]["player_1"][1], lambda board: True, raises)
    for match in play(schedule, with_faulty(always_failing)):
        faulty_index = match.contestants.index(BAD)
        assert all(faulty_index in {forfeit.contestant for forfeit in game.forfeits} for game in match.games)
        assert sorted(len(game.actions) for game in match.games) == [0, 1]
        assert match.score(faulty_index) == 0
        admit(match, schedule)


def test_forfeits_are_stored_accepted_and_replayed() -> None:
    schedule = schedule_of("script:one_ply", BAD, blocks=10)
    environment, forfeited = stock_stepping(CONFIG.environment, 1), 0
    for match in play(schedule, with_faulty(faulty(illegal))):
        admit(match, schedule)
        stored = replace(match, games=load_games(dump_games(match.games)))
        assert stored == match
        for index, game in enumerate(stored.games):
            steps = list(replay(environment, CONFIG, INTERFACE, stored, index))
            assert [move.action for step in steps for move in step.moves] == [*game.opening, *game.actions]
            assert [step.is_over for step in steps] == [False] * (len(steps) - 1) + [True]
            forfeited += bool(game.forfeits)
    assert forfeited


def test_rows_without_forfeits_can_be_read() -> None:
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
def test_a_forged_forfeit_is_detected_by_replay(change: str) -> None:
    matches = play(schedule_of("script:one_ply", BAD, blocks=10), with_faulty(faulty(raises)))
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    games = list(match.games)
    games[index] = FORGED[change](games[index], games[index].forfeits[0])
    with pytest.raises(EnvironmentMismatch, match="cannot be replayed"):
        list(
            replay(stock_stepping(CONFIG.environment, 1), CONFIG, INTERFACE, replace(match, games=tuple(games)), index)
        )


def test_a_mask_without_legal_actions_is_not_a_forfeit() -> None:
    environment = stock_stepping(CONFIG.environment, 2)
    start = environment.start

    def start_without_legal_actions(next_episode: Any) -> Any:
        turn = start(next_episode)
        for batch in turn.batches.values():
            batch.observations["action_mask"][:] = 0
        return turn

    environment.start = start_without_legal_actions  # type: ignore[method-assign]
    schedule = replace(schedule_of("tictactoe@1", "tictactoe@2"), opening_plies=0)
    with pytest.raises(IllegalMask, match="allows no action"):
        play_matches(schedule, [0], environment, INTERFACE, build_roster())


@dataclass
class FailingAtStep:
    """Acts until the `step`-th call of an episode, counted in its state, and then returns NaN."""

    step: int
    width: int

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        rows = len(observations["observation"])
        taken = np.zeros((rows, 1), np.float32) if state is None else state["state_in_0"]
        actions = np.where(taken == self.step, np.nan, 0.5) * np.ones((rows, self.width))
        return Actions(actions.astype(np.float32), {"state_in_0": taken + 1})


def failing_roster(kind: Kind, **steps: int) -> Roster:
    width = 5
    policies = {ref: FailingAtStep(step, width) for ref, step in steps.items()}
    return {
        f"kind@{ref}": {agent: (name, policy) for agent, name in kind.interface.policies.items()}
        for ref, policy in policies.items()
    }


CONTINUOUS = {"max_cycles": 6, "continuous_actions": True}
FREE = Kind("mpe2.simple_spread_v3", CONTINUOUS, None)
NEVER = 99


def play_pair(kind: Kind, first: int, second: int, num_envs: int = 4) -> tuple[Schedule, list[Match]]:
    schedule = kind.schedule(["kind@a", "kind@b"], plies=1)
    environment = stock_stepping(kind.config.environment, num_envs)
    rosters = failing_roster(kind, a=first, b=second)
    return schedule, play_matches(schedule, range(schedule.length), environment, kind.interface, rosters)


def test_a_forfeit_ends_the_game_for_all_agents() -> None:
    schedule, matches = play_pair(FREE, 3, NEVER)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert [forfeit.contestant for forfeit in game.forfeits] == [0]
            seat = game.sides.index(0)
            assert game.forfeits[0] == Forfeit(0, f"agent_{seat}", "not_finite")
            assert len(game.actions) == 3 * 3
            assert game.scores == (0.0, 1.0)
    assert play_pair(FREE, 3, NEVER, num_envs=1)[1] == matches


def test_two_simultaneous_forfeits_are_a_draw() -> None:
    schedule, matches = play_pair(FREE, 2, 2)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert {forfeit.contestant for forfeit in game.forfeits} == {0, 1}
            assert game.scores == (0.5, 0.5)


@dataclass
class Constant:
    """Always returns the same action, in another dtype than the space."""

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        return Actions(np.full((len(observations["observation"]), 5), 0.1, np.float64))


def test_actions_are_recorded_in_the_dtype_of_the_policy() -> None:
    """Rows are evaluated alone if a batch fails, which must not change the records."""
    schedule = FREE.schedule(["kind@a", "kind@b"], plies=0, blocks=6)
    policies = {
        "kind@a": Faulty(Constant(), lambda observation: bool(observation[2] > 0.8), raises),
        "kind@b": Constant(),
    }
    rosters = {ref: dict.fromkeys(FREE.interface.agents, ("shared", policy)) for ref, policy in policies.items()}

    def play(num_envs: int) -> list[Match]:
        environment = stock_stepping(FREE.config.environment, num_envs)
        return play_matches(schedule, range(schedule.length), environment, FREE.interface, rosters)

    alone = play(1)
    assert 0 < forfeits(alone, "kind@a") < 12
    assert {number for match in alone for game in match.games for action in game.actions for number in action} == {0.1}
    assert play(4) == play(12) == alone


SOLO = KINDS["continuous team"]
ROLES = Kind(
    "mpe2.simple_adversary_v3",
    CONTINUOUS,
    {"adversary": ["adversary_*"], "good": ["agent_*"]},
    {"adversary": ["adversary_*"], "good": ["agent_*"]},
)


@pytest.mark.parametrize("kind", [SOLO, ROLES], ids=["solo", "roles"])
@pytest.mark.parametrize(
    ("first", "second", "expected"), [(3, NEVER, 0.0), (NEVER, 0, 1.0), (2, 2, 0.5)], ids=["0", "1", "both"]
)
def test_compared_by_side_a_forfeit_loses_the_block(kind: Kind, first: int, second: int, expected: float) -> None:
    schedule, matches = play_pair(kind, first, second)
    assert schedule.scoring == "side"
    environment = stock_stepping(kind.config.environment, 1)
    for match in matches:
        admit(match, schedule)
        assert (match.score(0), match.score(1)) == (expected, 1 - expected)
        assert forfeit_difference(match, "kind@a") == 2 * expected - 1
        assert forfeit_difference(match, "kind@b") == 1 - 2 * expected
        for index, game in enumerate(match.games):
            assert all(forfeit.reason == "not_finite" for forfeit in game.forfeits)
            last = list(replay(environment, kind.config, kind.interface, match, index))[-1]
            assert last.is_over


def test_a_forfeited_game_has_no_return() -> None:
    """In simple_spread each step has a cost, so that a game which ends early would have a better return."""
    _, matches = play_pair(SOLO, 0, NEVER)
    assert all(match.games[0].returns[0] > match.games[1].returns[1] for match in matches)
    assert {match.mean_return(0) for match in matches} == {match.result().returns for match in matches} == {None}
    assert paired_difference(matches, "kind@a") is None
    table = {standing.ref: standing for standing in rank_contestants(whole(tally(matches)))}
    assert (table["kind@a"].mean_return, table["kind@a"].score, table["kind@a"].games) == (None, 0.0, len(matches))
    _, complete = play_pair(SOLO, NEVER, NEVER)
    assert {forfeit_difference(match, "kind@a") for match in complete} == {None}
    mixed = rank_contestants(whole(tally([*matches, *complete])))
    assert mixed[0].mean_return == pytest.approx(np.mean([match.mean_return(0) for match in complete]))


@pytest.mark.parametrize("crashes", [False, True], ids=["illegal", "crashes"])
def test_a_tournament_continues_with_a_version_that_forfeits(tmp_path: Path, crashes: bool) -> None:
    registry = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 32})
    for graph in (tictactoe.graph(), illegal_action_graph(crashes)):
        OnnxPolicy(graph)
        tictactoe.publish(registry, graph)
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=8)
    matches = Ledger(registry).matches(league=tictactoe.LEAGUE)
    reasons = {forfeit.reason for match in matches for game in match.games for forfeit in game.forfeits}
    assert reasons == {"crashed" if crashes else "illegal_action"}
    lost = report.forfeits["tictactoe@2"]
    assert (lost.games, lost.reasons) == (forfeits(matches, "tictactoe@2"), {reasons.pop(): lost.games})
    assert compute_leaderboard(registry, tictactoe.LEAGUE)[-1].ref == "tictactoe@2"
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    leaderboard = rank_contestants(whole(tally(matches)))
    assert {standing.ref: standing.mean_return for standing in leaderboard}["tictactoe@1"] is not None
    note = recorded_game(match.id, index, registry).note
    assert note is not None
    assert note.startswith("forfeited by tictactoe@2 as player_")
