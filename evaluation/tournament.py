"""A schedule is played: chunks of matches in this process or as Ray tasks, the ledger appended in schedule order.

Chunks are aligned, consecutive positions. A chunk that is done early waits until all before it are in the
ledger, and a chunk is appended whole or not at all. So the ledger always holds a prefix of the schedule, the same
whatever the number of workers, and a run that was killed goes on behind it. Of those that are under way or wait there
are never more than workers: one chunk per worker is the most that a kill can cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice, pairwise
from typing import get_args

import ray
from ray.exceptions import RayError, RayTaskError

from evaluation.budget import UNLIMITED, Budget, Limit
from evaluation.cluster import cluster, start
from evaluation.contestants import ANCHOR, baselines
from evaluation.course import DEFAULT_BLOCKS, MOST_BLOCKS, Course, Kind, draw_up
from evaluation.cross_play import cross_play_table
from evaluation.forfeits import forfeits
from evaluation.gate import distinct_games
from evaluation.ordering import InOrder
from evaluation.payoff import tabulate
from evaluation.player import player
from evaluation.population import population
from evaluation.report import EvaluationReport, Listener, Progress, StoppedBy, VerdictReport
from evaluation.schedule import scoring
from evaluation.standings import by_side, ranked
from league.errors import InvalidInput, LeagueError, WorkerLost
from league.policies.pinning import check_eligible, eligible, pinned
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import LeagueRow
from league.results.ledger import Ledger
from league.results.records import GAMES_PER_BLOCK, Match, Schedule
from league.settings import Storage

GAMES_PER_COPY = 4
"""Games of a chunk per environment copy: enough that handing chunks out costs little, few enough that little is played
in vain when a test stops or a worker dies."""

RETRIES = 5
"""How often a chunk whose worker died is given to another."""

Enough = Callable[[Sequence[Match]], bool]
"""All matches of a schedule so far, in order → whether it may end here."""


def run(
    schedule: Schedule,
    *,
    registry: Registry,
    workers: int = 0,
    enough: Enough | None = None,
    until: int | None = None,
    listener: Listener | None = None,
) -> list[Match]:
    """Play what is missing of `schedule` and return all its matches in order.

    workers: Ray tasks at once; 0 plays in this process. Without a Ray in this process a local one is started, and left
        running: `cluster` is its owner.
    enough: ends the schedule before its length; asked after each chunk, and before the first.
    until: matches at most; others may be in the ledger already, and are returned too.
    Raises what `Player.play` does, WorkerLost, and ConfigError for machines that do not share the registry.
    """
    ledger = Ledger(registry)
    schedule = ledger.open(schedule)
    config = registry.league(schedule.league).config
    matches = ledger.matches(league=schedule.league, schedule=schedule.id)
    end = schedule.length if until is None else min(until, schedule.length)
    chunks = chunks_of(end, len(matches), config.play.copies)
    document = config.model_dump_json(by_alias=True)
    played = (
        _in_ray(schedule, chunks, registry.storage, document, workers)
        if workers and chunks
        else _here(schedule, chunks, registry.storage, document)
    )
    with closing(played):
        while True:
            ended = enough is not None and enough(matches)
            if listener:
                listener(Progress(_words(schedule), len(matches), schedule.length))
            chunk = None if ended else next(played, None)
            if chunk is None:
                return matches
            ledger.extend(chunk)
            matches += chunk


def evaluate(
    league: str,
    refs: Sequence[str] = (),
    *,
    registry: Registry,
    schedule: Kind = "round_robin",
    against: Sequence[str] = (),
    blocks: int | None = None,
    budget: Budget = UNLIMITED,
    workers: int = 0,
    seed: int = 0,
    listener: Listener | None = None,
) -> EvaluationReport:
    """A tournament of `refs` and the scripted baselines; or cross-play of `refs` in one team.

    refs: versions, aliases (pinned to what they name now) and scripts; by default every version that was trained in the
        league's present environment.
    schedule: in a `round_robin` every pair meets in `blocks` matches; in a `gauntlet` each of `refs` meets each of
        `against` so often, by default the champion and the baselines; `adaptive` plays a quarter of a round robin's
        matches, where they tell most about the ranking; `cross_play` mixes pairs of `refs` in one team.
    blocks: by default 32, or as many as the budget allows.
    seed: other games for another seed; the same arguments again find their matches in the ledger and play nothing.
    Raises InvalidInput for options that do not go together, UnknownLeague, UnknownVersion, UnknownAlias, UnknownPolicy,
    EnvironmentMismatch, and what `run` raises.
    """
    row = registry.league(league)
    _check_options(schedule, against, budget)
    asked = [pinned(ref, league, registry) for ref in refs] or [each.ref for each in eligible(registry, league)]
    opponents: list[str] = []
    if schedule == "gauntlet":
        opponents = [pinned(ref, league, registry) for ref in against] or _opponents(registry, row)
    elif schedule != "cross_play":
        asked += baselines(row.interface)
    for ref in [*asked, *opponents]:
        check_eligible(ref, registry, row.config)
    contestants = list(dict.fromkeys(asked))
    blocks = blocks or (DEFAULT_BLOCKS if budget.is_open else MOST_BLOCKS)
    if budget.precision is not None and ANCHOR not in [*contestants, *opponents]:
        raise InvalidInput(f"precision: ratings are measured from {ANCHOR}, which nobody meets here")
    course = draw_up(row.config, row.interface, schedule, contestants, opponents, blocks, seed)
    with cluster():
        matches, stopped_by = _follow(course, budget, registry, workers, listener)
    return _report(row, schedule, course, matches, stopped_by)


def _check_options(schedule: Kind, against: Sequence[str], budget: Budget) -> None:
    if schedule not in get_args(Kind):
        raise InvalidInput(f"schedule: expected one of {', '.join(get_args(Kind))}, got {schedule!r}")
    if against and schedule != "gauntlet":
        raise InvalidInput(f"against: only a gauntlet has opponents of its own, not {schedule}")
    if budget.precision is not None and schedule == "cross_play":
        raise InvalidInput("precision: cross_play has no ratings that could be precise enough")


def _opponents(registry: Registry, row: LeagueRow) -> list[str]:
    champion = registry.aliases(row.slug).get(CHAMPION)
    return [*([] if champion is None else [f"{row.slug}@{champion}"]), *baselines(row.interface)]


def _follow(
    course: Course, budget: Budget, registry: Registry, workers: int, listener: Listener | None
) -> tuple[list[Match], StoppedBy]:
    """Play a course, one schedule after another, as far as the budget goes."""
    limit, matches = Limit(budget, course), list[Match]()

    def enough(own: Sequence[Match]) -> bool:
        return limit.is_reached([*matches, *own])

    def tell(progress: Progress | VerdictReport) -> None:
        if listener and isinstance(progress, Progress):
            listener(replace(progress, played=len(matches) + progress.played, of=limit.most))

    while not limit.is_reached(matches) and (schedule := course.following(matches)) is not None:
        until = limit.most - len(matches)
        matches += run(schedule, registry=registry, workers=workers, enough=enough, until=until, listener=tell)
    return limit.counted(matches)


def _report(
    row: LeagueRow, kind: Kind, course: Course, matches: Sequence[Match], stopped_by: StoppedBy
) -> EvaluationReport:
    tournament = () if kind == "cross_play" else course.contestants
    compared = "team" if kind == "cross_play" else scoring(row.config, row.interface)
    distinct = {ref: distinct_games(matches, ref) for ref in tournament}
    table = ranked((match.result() for match in matches), distinct) if tournament else ()
    order, sides = [standing.ref for standing in table], tuple(row.interface.sides)
    rated_by_side = compared == "side" and len(sides) > 1
    return EvaluationReport(
        league=row.slug,
        schedule=course.name,
        environment_digest=row.environment_digest,
        games=sum(len(match.games) for match in matches),
        distinct_games=distinct_games(matches),
        standings=table,
        payoff=tabulate(order, sides, matches if tournament else ()),
        scoring=compared,
        by_side=by_side(sides, matches) if rated_by_side else {},
        kind=kind,
        stopped_by=stopped_by,
        # Where others are picked by their ratings, some pairs meet once or twice, which says nothing of their payoffs.
        population=population(order, matches) if kind == "round_robin" else None,
        cross_play=None if tournament else cross_play_table(course.contestants, matches),
        forfeits={ref: lost for ref in course.contestants if (lost := forfeits(matches, ref))},
    )


def chunks_of(length: int, played: int, copies: int) -> list[range]:
    """What is missing of `length` positions behind the first `played`, cut at multiples of a chunk's size.

    A chunk keeps `copies` environments busy for a few games each.
    """
    size = math.ceil(GAMES_PER_COPY * copies / GAMES_PER_BLOCK)
    cuts = [played, *range((played // size + 1) * size, length, size), length]
    return [range(start, end) for start, end in pairwise(cuts) if start < end]


def _words(schedule: Schedule) -> str:
    first, *others = schedule.contestants
    if len(others) == 1:
        return f"{first} against {others[0]}"
    return f"{first} against {len(others)} others" if schedule.kind == "gauntlet" else f"{len(others) + 1} contestants"


def _here(schedule: Schedule, chunks: Sequence[range], storage: Storage, config: str) -> Generator[list[Match]]:
    for chunk in chunks:
        yield player(storage, config).play(schedule, chunk)


def _in_ray(
    schedule: Schedule, chunks: Sequence[range], storage: Storage, config: str, workers: int
) -> Generator[list[Match]]:
    """The chunks in order. A chunk begins when one of `workers` before it has been taken.

    Raises ConfigError if the nodes of the cluster do not share `storage`.
    """
    start(workers)
    storage.check_reach({node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]})
    job = ray.put((schedule, storage, config))
    waiting = enumerate(chunks)
    flying: dict[ray.ObjectRef, int] = {}
    done: InOrder[list[Match]] = InOrder()
    while done.due < len(chunks):
        room = workers - len(flying) - len(done)
        flying |= {_play_chunk.remote(job, chunk): index for index, chunk in islice(waiting, room)}
        if (chunk := done.take()) is not None:
            yield chunk
            continue
        for ref in ray.wait(list(flying))[0]:
            index = flying.pop(ref)
            done.put(index, _result(ref, schedule, chunks[index]))


@ray.remote(num_cpus=1, max_retries=RETRIES)  # type: ignore[untyped-decorator]
def _play_chunk(job: tuple[Schedule, Storage, str], chunk: range) -> list[Match]:
    schedule, storage, config = job
    return player(storage, config).play(schedule, chunk, expendable=True)


def _result(ref: ray.ObjectRef, schedule: Schedule, chunk: range) -> list[Match]:
    try:
        matches: list[Match] = ray.get(ref)
    except RayTaskError as error:
        # Ray wraps what a task raised; a person is told the fault itself.
        if isinstance(error.cause, LeagueError):
            raise error.cause from None
        raise
    except RayError as error:
        players = " and ".join(dict.fromkeys(ref for position in chunk for ref in schedule.contestants_at(position)))
        raise WorkerLost(
            f"workers died {RETRIES + 1} times over matches {chunk.start} to {chunk.stop - 1} of {schedule.id}, of"
            f" {players}; their logs say where they were: {error}"
        ) from error
    return matches
