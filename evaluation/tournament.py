"""A schedule is played: chunks of matches in this process or as Ray tasks, the ledger appended in schedule order.

Chunks are aligned, consecutive positions. A chunk that is done early waits until all before it are in the
ledger, and a chunk is appended whole or not at all. So the ledger always holds a prefix of the schedule, the same
whatever the number of workers, and a run that was killed goes on behind it: at most the chunks in flight are
played again.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import islice, pairwise

import ray
from ray.exceptions import RayError, RayTaskError

from evaluation.contestants import baselines
from evaluation.forfeits import forfeits
from evaluation.gate import distinct_games
from evaluation.ordering import InOrder
from evaluation.payoff import tabulate
from evaluation.player import player
from evaluation.report import EvaluationReport, Listener, Progress
from evaluation.schedule import round_robin
from evaluation.standings import by_side, ranked
from league.errors import LeagueError, WorkerLost
from league.policies.pinning import check_eligible, eligible, pinned
from league.registry.registry import Registry
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
    listener: Listener | None = None,
) -> list[Match]:
    """Play what is missing of `schedule` and return all its matches in order.

    workers: Ray tasks at once; 0 plays in this process. Without a Ray in this process a local one is started, and left
        running: `cluster` is its owner.
    enough: ends the schedule before its length; asked after each chunk, and before the first.
    Raises what `Player.play` does, and WorkerLost.
    """
    ledger = Ledger(registry)
    schedule = ledger.open(schedule)
    config = registry.league(schedule.league).config
    matches = ledger.matches(league=schedule.league, schedule=schedule.id)
    chunks = chunks_of(schedule.length, len(matches), config.play.copies)
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
    blocks: int = 32,
    workers: int = 0,
    seed: int = 0,
    listener: Listener | None = None,
) -> EvaluationReport:
    """A round robin of `refs` and the scripted baselines, every pair meeting in `blocks` matches.

    refs: versions, aliases (pinned to what they name now) and scripts; by default every version that was trained in the
        league's present environment.
    seed: other games for another seed; the same arguments again find their matches in the ledger and play nothing.
    Raises UnknownLeague, UnknownVersion, UnknownAlias, UnknownPolicy, EnvironmentMismatch, and what `run` raises.
    """
    row = registry.league(league)
    asked = [pinned(ref, league, registry) for ref in refs] or [each.ref for each in eligible(registry, league)]
    for ref in asked:
        check_eligible(ref, registry, row.config)
    contestants = list(dict.fromkeys([*asked, *baselines(row.interface)]))
    schedule = round_robin(row.config, row.interface, contestants, blocks, seed)
    with cluster():
        matches = run(schedule, registry=registry, workers=workers, listener=listener)
    distinct = {ref: distinct_games(matches, ref) for ref in contestants}
    table = ranked((match.result() for match in matches), distinct)
    rated_by_side = schedule.scoring == "side" and len(schedule.sides) > 1
    return EvaluationReport(
        league=league,
        schedule=schedule.id,
        environment_digest=schedule.environment_digest,
        games=sum(len(match.games) for match in matches),
        distinct_games=distinct_games(matches),
        standings=table,
        payoff=tabulate([standing.ref for standing in table], schedule.sides, matches),
        scoring=schedule.scoring,
        by_side=by_side(schedule.sides, matches) if rated_by_side else {},
        forfeits={ref: lost for ref in contestants if (lost := forfeits(matches, ref))},
    )


@contextmanager
def cluster() -> Iterator[None]:
    """Owns the Ray that `run` may start inside the block: it ends with it. A Ray that was there before is
    left alone.
    """
    owner = not ray.is_initialized()
    try:
        yield
    finally:
        if owner and ray.is_initialized():
            ray.shutdown()


def _start_ray(workers: int) -> None:
    ray.init(
        address="local",
        num_cpus=workers,
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
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
    """The chunks in order.

    At most `workers + 1` are under way, and no more than a few done ones wait for their turn.
    """
    if not ray.is_initialized():
        _start_ray(workers)
    job = ray.put((schedule, storage, config))
    waiting = enumerate(chunks)
    flying: dict[ray.ObjectRef, int] = {}
    done: InOrder[list[Match]] = InOrder()
    while done.due < len(chunks):
        room = min(workers + 1 - len(flying), 4 * workers - len(flying) - len(done))
        flying |= {_play_chunk.remote(job, chunk): index for index, chunk in islice(waiting, max(0, room))}
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
