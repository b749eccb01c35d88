"""The exceptions of the program, with stable error codes for the HTTP API.

Errors are raised where they occur and translated once: by the CLI to an exit code, by the server to an HTTP status.
"""

from typing import ClassVar


class LeagueError(Exception):
    """Base class. The message is one sentence for the user; `code` is stable, so clients may rely on it."""

    code: ClassVar[str] = "league_error"

    def __init_subclass__(cls, *, code: str | None = None) -> None:
        # Ray derives a class without a code from that of an error in a remote task.
        cls.code = code or cls.code

    @property
    def public_message(self) -> str:
        """The message for callers on other machines."""
        return str(self)


class InvalidInput(LeagueError, code="invalid_input"):
    """The input is invalid."""


class ConfigError(InvalidInput, code="invalid_config"):
    """A configuration is invalid. The message names the file, the key and the expected value."""


class InvalidReference(InvalidInput, ValueError, code="invalid_reference"):
    """A reference is malformed. Valid ones: `connect_four@3`, `connect_four@champion`, `script:random`.

    A ValueError, so that a model of Pydantic that contains a reference reports it as a fault of its field.
    """


class ObservationError(InvalidInput, code="invalid_observation"):
    """The shape, dtype or values of an observation do not fit its space."""


class IllegalMask(InvalidInput, code="illegal_mask"):
    """An action mask contains values other than 0 and 1, or allows no action."""


class IllegalAction(InvalidInput, code="illegal_action"):
    """An action is outside its space or its mask."""


class InvalidReward(InvalidInput, code="invalid_reward"):
    """A reward is not a finite number."""


class InvalidState(InvalidInput, code="invalid_state"):
    """A recurrent state is malformed, or belongs to another policy or version."""


class BodyTooLarge(InvalidInput, code="body_too_large"):
    """A request body or batch exceeds the limit."""


class EnvironmentMismatch(InvalidInput, code="environment_mismatch"):
    """An environment, script or version does not fit the league."""


class InvalidReturn(EnvironmentMismatch):
    """An environment returned something else than its API requires."""


class NotFound(LeagueError, code="not_found"):
    """A named object does not exist."""


class UnknownLeague(NotFound, code="unknown_league"):
    """No league with this name is registered."""


class UnknownVersion(NotFound, code="unknown_version"):
    """The league has no ready version with this number."""


class VersionRetired(NotFound, code="version_retired"):
    """The files of a version were removed; episodes that are pinned to it cannot continue."""


class UnknownAlias(NotFound, code="unknown_alias"):
    """The league has no alias with this name."""


class UnknownPolicy(NotFound, code="unknown_policy"):
    """The version has no policy with this id."""


class UnknownEvaluation(NotFound, code="unknown_evaluation"):
    """The league has no evaluation with this number."""


class UnknownRun(NotFound, code="unknown_run"):
    """The league has no training run with this name."""


class UnknownVerdict(NotFound, code="unknown_verdict"):
    """No verdict with this id exists."""


class UnknownMatch(NotFound, code="unknown_match"):
    """The ledger has no match with this id, or the match has no such game."""


class UnknownKey(NotFound, code="unknown_key"):
    """No API key with this name exists."""


class Conflict(LeagueError, code="conflict"):
    """The current state differs from the one that the request assumes."""


class AliasMoved(Conflict, code="alias_moved"):
    """A compare-and-set of an alias failed because the alias had been moved."""


class InterfaceChanged(Conflict, code="interface_changed"):
    """Spaces or policy ids differ from those of the league's versions."""


class LedgerConflict(Conflict, code="ledger_conflict"):
    """A match is incomplete or not part of its schedule."""


class NothingToRollBack(Conflict, code="nothing_to_roll_back"):
    """The alias has no previous version."""


class NameTaken(Conflict, code="name_taken"):
    """A name that must be unique is already in use."""


class NotPromotable(Conflict, code="not_promotable"):
    """The version's role excludes it from promotion."""


class LeagueArchived(Conflict, code="league_archived"):
    """Nothing is trained, published or tested in an archived league."""


class KeyReused(Conflict, code="idempotency_key_reused"):
    """An Idempotency-Key was already used for a different request."""


class AlreadyRunning(Conflict, code="already_running"):
    """Another process holds an exclusive task or port."""


class Unauthenticated(LeagueError, code="unauthenticated"):
    """An API key is missing or invalid."""


class Forbidden(LeagueError, code="forbidden"):
    """The API key lacks the required scope."""


class RateLimited(LeagueError, code="rate_limited"):
    """The API key exceeded its rate limit. `wait`: seconds until the next request is accepted."""

    def __init__(self, message: str, wait: float = 1.0) -> None:
        super().__init__(message)
        self.wait = wait


class Overloaded(LeagueError, code="overloaded"):
    """The replica has more concurrent requests than it accepts."""


class TooManyEvaluations(Overloaded, code="too_many_evaluations"):
    """More evaluations are queued or running than the server accepts."""


class DeadlineExceeded(LeagueError, code="deadline_exceeded"):
    """A request was not answered within its timeout."""


class GraphTimeout(DeadlineExceeded, code="graph_timeout"):
    """A run of a policy's graph took too long, and was ended."""


class ArtifactCorrupt(LeagueError, code="artifact_corrupt"):
    """A file of a version is missing, or its digest differs from the manifest."""


class FilesMissing(ArtifactCorrupt):
    """All files of a version are missing. The message names the place, after a colon."""

    @property
    def public_message(self) -> str:
        """The message without the place, which is in the server's log."""
        return str(self).partition(":")[0]


class RunCorrupt(LeagueError, code="run_corrupt"):
    """The record of a training run is not valid: a file was changed, or another release wrote it."""


class GameHung(LeagueError, code="game_hung"):
    """A game has not ended after `play.max_moves` steps or `play.game_seconds` of environment time."""


class BoundExceeded(LeagueError, code="bound_exceeded"):
    """The returns in a block differ by more than `gate.return_bound`."""


class OutOfSpace(LeagueError, code="out_of_space"):
    """The recorded games of a schedule have reached their limit, or their disk is nearly full."""


class GameCrashed(LeagueError, code="game_crashed"):
    """The environment of a game raised an exception in a reset or after a legal action."""


class ExploiterMissing(LeagueError, code="exploiter_missing"):
    """A verdict waits for an exploiter that could not be trained."""


class VerdictRefuted(LeagueError, code="verdict_refuted"):
    """The record of a verdict contradicts the games in the ledger."""


class WorkerLost(LeagueError, code="worker_lost"):
    """The worker processes of a task died repeatedly."""


class ParityError(LeagueError, code="parity_failed"):
    """An exported graph and the trained module choose different actions."""


class NotReady(LeagueError, code="not_ready"):
    """A policy exists but is not served yet, or what serves and trains did not start."""


class NoEvaluationService(NotReady, code="no_evaluation_service"):
    """The server was deployed without an evaluation service, or the service is unreachable."""


class NoSearchService(NotReady, code="no_search_service"):
    """The server was deployed without a search service."""


class NoSimulation(NotReady, code="no_simulation"):
    """No training run or evaluation needs episodes of simulators."""


class NoReplica(NotReady, code="no_replica"):
    """No replica of a policy server accepts requests."""


class RemoteError(LeagueError, code="remote_error"):
    """A policy server is unreachable or failed."""


class ReplicaLost(RemoteError, code="replica_lost"):
    """A replica of a policy server ended before it responded."""


class StorageError(LeagueError, code="storage_error"):
    """The database or the artefact store cannot be read or written. The message may name files, hosts and users."""

    @property
    def public_message(self) -> str:
        """The message without details of this machine, which are in the server's log."""
        return "the registry's database or files cannot be used; see the server log"


def one_line(error: BaseException, with_type: bool = False, first_line: bool = False) -> str:
    """Return the message of an error on one line, or the name of its type if the message is empty.

    with_type: put the name of the type before the message. first_line: leave out the others, which may be a traceback.
    """
    text, kind = str(error).strip(), type(error).__name__
    message = " ".join((text.partition("\n")[0] if first_line else text).split())
    return f"{kind}: {message}" if with_type and message else message or kind


BY_CODE: dict[str, type[LeagueError]] = {
    error.code: error for error in list(vars().values()) if isinstance(error, type) and issubclass(error, LeagueError)
}
"""Error code → exception class."""
