"""Plays schedules and evaluations: matches run in chunks, here or as Ray tasks, and are appended in schedule order.

Chunks are ranges of consecutive positions with fixed bounds. A chunk that finishes early waits for all earlier chunks,
and is appended as a whole or not at all. The ledger therefore always holds a prefix of the schedule, independent of the
number of workers, and an interrupted run resumes after it. At most one chunk per worker is in flight or waiting, which
limits the loss of an interruption.

A test may stop after any match, but is only looked at between chunks. Matches after its stopping match stay in the
ledger and do not count (evaluation/gating/gate.py), so chunks influence no decision.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice, pairwise
from time import monotonic, perf_counter
from typing import Generic, TypeVar, get_args

import ray
from ray.exceptions import RayError, RayTaskError

from evaluation.documents import EvaluationReport, Listener, Progress, StoppedBy
from evaluation.matches.game_records import forfeits_of_all, unique_games
from evaluation.matches.leaderboard import by_side, rank_contestants
from evaluation.matches.watchdog import CLOSE_SECONDS
from evaluation.matches.worker import match_worker, num_envs
from evaluation.schedules.builders import ANCHOR
from evaluation.schedules.tournament_plan import (
    DEFAULT_BLOCKS,
    MOST_BLOCKS,
    UNLIMITED,
    Budget,
    Kind,
    StoppingRule,
    TournamentPlan,
    plan_tournament,
)
from evaluation.statistics.payoff import cross_play_table, tabulate
from evaluation.statistics.population import population
from league.config.league import LeagueConfig
from league.environments import building
from league.errors import InvalidInput, LeagueError, WorkerLost, one_line
from league.policies.loading import baselines, check_contestants, check_eligible, check_plays, eligible, pinned
from league.ray_cluster import (
    check_stack,
    check_stacks,
    cluster_cpus,
    ensure_local,
    node_addresses,
    node_cpus,
    node_ids,
    ray_session,
    usable_cpus,
)
from league.refs import CHAMPION, ScriptRef
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.results.ledger import Ledger
from league.results.records import GAMES_PER_BLOCK, Match, Schedule
from league.results.scoring import scoring
from league.results.sums import tally, whole
from league.settings import Storage
from league.stack import installed_with_this

T = TypeVar("T")


class ReorderBuffer(Generic[T]):
    """Takes items by index 0, 1, … in any order and returns them in order of the index."""

    def __init__(self) -> None:
        self.due = 0
        """The place of the next item to come out."""
        self._waiting: dict[int, T] = {}

    def __len__(self) -> int:
        """Number of waiting items."""
        return len(self._waiting)

    def put(self, place: int, item: T) -> None:
        """Add a finished item."""
        self._waiting[place] = item

    def take(self) -> T | None:
        """The next item in order; None while it is missing."""
        if self.due not in self._waiting:
            return None
        item = self._waiting.pop(self.due)
        self.due += 1
        return item


GAMES_PER_ENV = 4
"""Most games of a chunk per parallel environment: enough that handing chunks out costs little, few enough that little
is played in vain when a test stops or a worker dies."""

RETRIES = 5
"""How often a chunk is retried after its worker died."""
NODE_CHECK = 5.0
"""Seconds without a result after which lost nodes are looked for."""
NODE_COUNT = 1.0
"""Seconds between two counts of the cluster's CPUs."""

StopCondition = Callable[[Sequence[Match]], bool]
"""All matches of a schedule so far, in order → whether to stop."""


def play_schedule(
    schedule: Schedule,
    *,
    registry: Registry,
    workers: int | None = 0,
    enough: StopCondition | None = None,
    until: int | None = None,
    listener: Listener | None = None,
) -> list[Match]:
    """Play the missing matches of `schedule` and return all its matches in order.

    Args:
        schedule: The schedule; stored in the ledger if it is new.
        registry: Registry of the league.
        workers: Parallel Ray tasks; 0 plays in this process. None: one for each CPU of the cluster, also of nodes that
            join. A local Ray is started if none is connected, and left running: `ray_session` owns it.
        enough: Ends the schedule early; called before the first chunk and after each.
        until: Maximum number of matches. The ledger may contain more, which are returned as well.
        listener: Receives progress.

    Raises:
        LeagueError: The errors of `MatchWorker.play`.
        WorkerLost: Workers died repeatedly.
        ConfigError: The cluster's machines do not share the registry.
    """
    ledger = Ledger(registry)
    schedule = ledger.open(schedule)
    config = registry.leagues.get(schedule.league).config
    if config.environment.external is not None:
        workers = 0  # simulators play, and this process asks the contestants for actions
    matches = ledger.matches(league=schedule.league, schedule=schedule.id)
    end = schedule.length if until is None else min(until, schedule.length)
    chunks = chunks_of(end, len(matches), num_envs(config))
    document = config.model_dump_json(by_alias=True)
    places = _Places(workers)
    played = (
        _in_this_process(schedule, chunks, registry.storage, document)
        if workers == 0 or not chunks
        else _in_ray(schedule, chunks, registry.storage, document, places)
    )
    began, moves = perf_counter(), 0
    with closing(played):
        while True:
            ended = enough is not None and enough(matches)
            if listener:
                speed = moves / (perf_counter() - began) if moves else None
                progress = Progress(_describe(schedule), len(matches), schedule.length, speed)
                listener(replace(progress, nodes=places.nodes, cpus=places.cpus))
            chunk = None if ended else next(played, None)
            if chunk is None:
                return matches
            ledger.extend(chunk)
            matches += chunk
            moves += sum(len(game.opening) + len(game.actions) for match in chunk for game in match.games)


def evaluate(
    league: str | LeagueConfig,
    refs: Sequence[str] = (),
    *,
    registry: Registry,
    schedule: Kind = "round_robin",
    against: Sequence[str] = (),
    blocks: int | None = None,
    budget: Budget = UNLIMITED,
    workers: int | None = 0,
    seed: int = 0,
    listener: Listener | None = None,
) -> EvaluationReport:
    """Play a tournament of `refs` and the scripted baselines, or cross-play of `refs` in one team.

    Args:
        league: The league, or its configuration, which is registered.
        refs: Versions, aliases (resolved now) and scripts. By default all versions trained in the current environment.
        registry: Registry of the league.
        schedule: `round_robin`: every pair plays `blocks` matches. `gauntlet`: each of `refs` plays each of `against`.
            `adaptive`: a quarter of a round robin's matches, chosen to reduce rating uncertainty most. `cross_play`:
            pairs of `refs` play in one team.
        against: Opponents in a gauntlet; by default the champion and the baselines.
        blocks: Matches per pair; by default 32, or as many as the budget allows.
        budget: Limits of games, minutes or precision.
        workers: Parallel Ray tasks, as in `play_schedule`.
        seed: Selects other games. Repeating a call with equal arguments finds its matches in the ledger.
        listener: Receives progress.

    Raises:
        InvalidInput: Options that do not fit together.
        ConfigError: A version among the anchors of the league does not exist or cannot play.
        LeagueError: UnknownLeague, InterfaceChanged, UnknownVersion, UnknownAlias, UnknownPolicy, EnvironmentMismatch,
            and the errors of `play_schedule`.
    """
    if isinstance(league, LeagueConfig):
        registry.leagues.register(league, building.interface(league))
        league = league.league
    row = registry.leagues.follow_code(league, building.interface)
    _check_options(schedule, against, budget)
    check_contestants(row.config, None, registry)
    requested = [pinned(ref, league, registry) for ref in refs] or [
        version.ref for version in eligible(registry, league)
    ]
    opponents: list[str] = []
    if schedule == "gauntlet":
        opponents = [pinned(ref, league, registry) for ref in against] or _opponents(registry, row)
    elif schedule != "cross_play":
        requested += fixed_baselines(registry, row)
    for ref in [*requested, *opponents]:
        check_eligible(ref, registry, row.config)
        if ref.startswith("script:"):
            check_plays(ScriptRef.parse(ref), row.interface)
    contestants = list(dict.fromkeys(requested))
    blocks = blocks or (DEFAULT_BLOCKS if budget.is_open else MOST_BLOCKS)
    if budget.precision is not None and ANCHOR not in [*contestants, *opponents]:
        raise InvalidInput(f"precision: ratings are relative to {ANCHOR}, which does not play in this evaluation")
    plan = plan_tournament(row.config, row.interface, schedule, contestants, opponents, blocks, seed)
    with ray_session():
        matches, stopped_by = _play_plan(plan, budget, registry, workers, listener)
    return _report(row, schedule, plan, matches, stopped_by)


def _check_options(schedule: Kind, against: Sequence[str], budget: Budget) -> None:
    if schedule not in get_args(Kind):
        raise InvalidInput(f"schedule: expected one of {', '.join(get_args(Kind))}, got {schedule!r}")
    if against and schedule != "gauntlet":
        raise InvalidInput(f"against: only a gauntlet has separate opponents, not {schedule}")
    if budget.precision is not None and schedule == "cross_play":
        raise InvalidInput("precision: cross_play computes no ratings")


def _opponents(registry: Registry, row: LeagueRow) -> list[str]:
    champion = registry.aliases.current(row.slug).get(CHAMPION)
    return [*([] if champion is None else [f"{row.slug}@{champion}"]), *fixed_baselines(registry, row)]


def fixed_baselines(registry: Registry, row: LeagueRow) -> list[str]:
    """Return the baselines of a league, in which remote models are replaced by the versions that answer now."""
    return [pinned(ref, row.slug, registry) for ref in baselines(row.config, row.interface)]


def _play_plan(
    plan: TournamentPlan, budget: Budget, registry: Registry, workers: int | None, listener: Listener | None
) -> tuple[list[Match], StoppedBy]:
    """Play the schedules of a plan until its end or the limit of the budget."""
    limit, matches = StoppingRule(budget, plan), list[Match]()

    def enough(own: Sequence[Match]) -> bool:
        return limit.is_reached([*matches, *own])

    def report_progress(progress: Progress) -> None:
        if listener:
            listener(replace(progress, played=len(matches) + progress.played, of=limit.most))

    while not limit.is_reached(matches) and (schedule := plan.next_schedule(matches)) is not None:
        until = limit.most - len(matches)
        matches += play_schedule(
            schedule, registry=registry, workers=workers, enough=enough, until=until, listener=report_progress
        )
    return limit.counted(matches)


def _report(
    row: LeagueRow, kind: Kind, plan: TournamentPlan, matches: Sequence[Match], stopped_by: StoppedBy
) -> EvaluationReport:
    tournament = () if kind == "cross_play" else plan.contestants
    compared = "team" if kind == "cross_play" else scoring(row.config, row.interface)
    distinct = {ref: unique_games(matches, ref) for ref in tournament}
    sums = tally(matches)
    table = rank_contestants(whole(sums), distinct) if tournament else ()
    order, sides = [standing.ref for standing in table], tuple(row.interface.sides)
    rated_by_side = compared == "side" and len(sides) > 1
    return EvaluationReport(
        league=row.slug,
        schedule=plan.name,
        environment_digest=row.environment_digest,
        games=sum(len(match.games) for match in matches),
        unique_games=unique_games(matches),
        leaderboard=table,
        payoff=tabulate(order, sides, sums if tournament else {}),
        scoring=compared,
        actions=row.conditions.actions,
        by_side=by_side(sides, sums) if rated_by_side else {},
        kind=kind,
        stopped_by=stopped_by,
        # Pairs chosen by rating may meet only once or twice, too rarely to estimate payoffs.
        population=population(order, sums) if kind == "round_robin" else None,
        cross_play=None if tournament else cross_play_table(plan.contestants, matches),
        forfeits=forfeits_of_all(matches),
    )


def chunks_of(length: int, played: int, num_envs: int) -> list[range]:
    """The positions from `played` to `length`, in chunks.

    A chunk is as long as all earlier ones together, so that a test that stops after a few matches has played at most
    twice as many. It has at least one game for each parallel environment and at most GAMES_PER_ENV.
    """
    least, most = (math.ceil(games * num_envs / GAMES_PER_BLOCK) for games in (1, GAMES_PER_ENV))
    cuts = [0]
    while cuts[-1] < length:
        cuts.append(min(cuts[-1] + min(max(cuts[-1], least), most), length))
    return [range(max(start, played), end) for start, end in pairwise(cuts) if end > played]


def _describe(schedule: Schedule) -> str:
    first, *rivals = schedule.contestants
    if schedule.kind == "exploitability":
        return f"{first} and {rivals[0]} against their exploiters"
    if schedule.common_seeds:
        return f"{first} and {rivals[0]} against {rivals[1]}"
    if len(rivals) == 1:
        return f"{first} against {rivals[0]}"
    return f"{first} against {len(rivals)} others" if schedule.kind == "gauntlet" else f"{len(rivals) + 1} contestants"


class _Places:
    """The nodes and CPUs of a cluster on which chunks are played.

    workers: the number of chunks that are played at once; None for one on each CPU, which are counted from time to
    time, as nodes come and go.
    """

    def __init__(self, workers: int | None) -> None:
        self.fixed = workers
        self.at_once = workers or 0
        self.nodes: int | None = None
        self.cpus: int | None = None
        self._latest: deque[str] = deque()
        self._next_count = 0.0

    def count(self, storage: Storage) -> None:
        """Update the number of chunks that are played at once.

        Raises ConfigError if a node has joined that does not share `storage`.
        """
        if monotonic() >= self._next_count:
            self._next_count = monotonic() + NODE_COUNT
            storage.check_reach(node_addresses())
            if self.fixed is None:
                self.at_once = max(1, cluster_cpus())

    def played(self, node: str) -> None:
        """Record the node of a finished chunk and update the nodes and CPUs in use."""
        self._latest.append(node)
        cpus = node_cpus(set(self._latest))
        alive = [node_id for node_id in self._latest if node_id in cpus]
        self._latest = deque(alive, maxlen=self.at_once)
        if alive:
            used = set(self._latest)
            self.nodes, self.cpus = len(used), min(self.at_once, int(sum(cpus[node_id] for node_id in used)))


def _in_this_process(
    schedule: Schedule, chunks: Sequence[range], storage: Storage, config: str
) -> Generator[list[Match]]:
    """The chunks in order."""
    if not chunks:
        return
    worker = match_worker(storage, config)
    try:
        for chunk in chunks:
            yield worker.play(schedule, chunk)
    finally:
        worker.close_environment()


def _in_ray(
    schedule: Schedule, chunks: Sequence[range], storage: Storage, config: str, places: _Places
) -> Generator[list[Match]]:
    """The chunks in order. A chunk starts when an earlier one has been taken.

    Raises ConfigError if the nodes of the cluster do not share `storage`.
    """
    ensure_local(places.at_once or usable_cpus())
    places.count(storage)
    check_stacks()
    job = ray.put((schedule, storage, config, installed_with_this()))
    waiting = enumerate(chunks)
    flying: dict[ray.ObjectRef, int] = {}
    done: ReorderBuffer[list[Match]] = ReorderBuffer()
    nodes, latest = node_ids(), monotonic()
    try:
        while done.due < len(chunks):
            places.count(storage)
            room = max(0, places.at_once - len(flying) - len(done))
            flying |= {_play_chunk.remote(job, chunk): index for index, chunk in islice(waiting, room)}
            if (chunk := done.take()) is not None:
                yield chunk
                continue
            finished, _ = ray.wait(list(flying), timeout=NODE_COUNT)
            for ref in finished:
                index = flying.pop(ref)
                node, matches = _result(ref, schedule, chunks[index])
                done.put(index, matches)
                places.played(node)
                latest = monotonic()
            if monotonic() - latest >= NODE_CHECK:
                latest = monotonic()
                before, nodes = nodes, node_ids()
                if before - nodes:
                    # Ray repeats a task of a machine that vanished once its connection has been silent for minutes. The
                    # matches of a chunk are the same wherever and however often they are played.
                    flying = {_play_chunk.remote(job, chunks[index]): index for index in flying.values()}
    finally:
        _cancel(list(flying))


def _cancel(tasks: list[ray.ObjectRef]) -> None:
    """Interrupt chunks that are not needed, and wait until they have closed their environments."""
    for task in tasks:
        ray.cancel(task)
    if tasks:
        ray.wait(tasks, num_returns=len(tasks), timeout=CLOSE_SECONDS)


@ray.remote(num_cpus=1, max_retries=RETRIES)  # type: ignore[untyped-decorator]
def _play_chunk(job: tuple[Schedule, Storage, str, dict[str, str]], chunk: range) -> tuple[str, list[Match]]:
    """The id of the node that played, and the matches."""
    schedule, storage, config, stack = job
    check_stack(stack, "of the driver")  # this node may have joined the cluster later
    worker = match_worker(storage, config)
    try:
        matches = worker.play(schedule, chunk, expendable=True)
    finally:
        worker.close_environment(expendable=True)  # Ray does not tell its processes that they end
    return ray.get_runtime_context().get_node_id(), matches


def _result(ref: ray.ObjectRef, schedule: Schedule, chunk: range) -> tuple[str, list[Match]]:
    try:
        played: tuple[str, list[Match]] = ray.get(ref)
    except RayTaskError as error:
        # Ray wraps exceptions of tasks.
        if isinstance(error.cause, LeagueError):
            raise error.cause from None
        raise
    except RayError as error:
        players = " and ".join(dict.fromkeys(ref for position in chunk for ref in schedule.contestants_at(position)))
        raise WorkerLost(
            f"workers died {RETRIES + 1} times over matches {chunk.start} to {chunk.stop - 1} of {schedule.id}, of"
            f" {players}; see the logs of the workers: {one_line(error)}"
        ) from error
    return played
