"""The error hierarchy. Errors are raised low and translated once, at the edge (the CLI's exit code, the HTTP status).

LeagueError
├── InvalidInput              the caller's mistake
│   ├── ConfigError             a league's YAML file, or a setting
│   ├── InvalidReference        text that is no reference
│   ├── ObservationError        an array that does not fit its space
│   ├── IllegalMask             an action mask that is not one, or allows nothing
│   ├── IllegalAction           an action outside the mask or the space
│   ├── InvalidReward           a reward that is no finite number
│   ├── InvalidState            recurrent state that no reply gave, or that is another version's
│   ├── BodyTooLarge            a request, or a batch in it, beyond the limit
│   └── EnvironmentMismatch     an environment, script or version that does not belong together
├── NotFound
│   ├── UnknownLeague
│   ├── UnknownVersion
│   ├── VersionRetired          a version that is served no more
│   ├── UnknownAlias
│   ├── UnknownPolicy
│   ├── UnknownEvaluation
│   ├── UnknownRun
│   ├── UnknownVerdict
│   ├── UnknownMatch
│   └── UnknownKey
├── Conflict                  the world has moved on
│   ├── AliasMoved              a compare-and-set lost
│   ├── InterfaceChanged        other spaces or policy ids than the league's versions have
│   ├── LedgerRefusal           a result that breaks its schedule
│   ├── NothingToRollBack
│   ├── NameTaken
│   ├── KeyReused               an Idempotency-Key that stands for another call
│   └── AlreadyRunning          a second one of what may run once
├── Unauthenticated           no API key where one is needed, or one that opens nothing
├── Forbidden                 an API key that is not for this
├── RateLimited               an API key that calls more often than it may
├── Overloaded                more requests at once than a server takes
│   └── TooManyEvaluations      more evaluations at once than it takes
├── DeadlineExceeded          a request that was not answered in its time
├── ArtifactCorrupt           a file whose digest is not the manifest's
├── GameHung                  a game that does not end
├── BoundExceeded             returns that differ by more than a gate was told they can
├── GameCrashed               a game whose environment raised
├── WorkerLost                worker processes that die again and again
├── VerdictRefuted            a verdict whose record is not what its games say
├── ParityError               an exported graph that acts otherwise than the trained module
├── NotReady                  a policy that nothing serves yet
│   └── NoStudio                a server without what plays games
├── RemoteError               a policy server that cannot be reached or failed
└── StorageError              disk full, read-only, database gone
"""

from typing import ClassVar


class LeagueError(Exception):
    """A fault that a person is told in one sentence. `code` is stable: clients may rely on it."""

    code: ClassVar[str] = "league_error"


class InvalidInput(LeagueError):
    """What the caller gave cannot be used."""

    code = "invalid_input"


class ConfigError(InvalidInput):
    """A configuration that is refused; the message names the file, the key and what was expected."""

    code = "invalid_config"


class InvalidReference(InvalidInput):
    """Text that is no reference such as `connect_four@3`, `connect_four@champion` or `script:random`."""

    code = "invalid_reference"


class ObservationError(InvalidInput):
    """An observation whose shape, dtype or values do not fit its space."""

    code = "invalid_observation"


class IllegalMask(InvalidInput):
    """An action mask that holds something other than 0 and 1, or allows no action."""

    code = "illegal_mask"


class IllegalAction(InvalidInput):
    """An action outside its space or its mask."""

    code = "illegal_action"


class InvalidReward(InvalidInput):
    """A reward that is no finite number: nothing can be learned from it, and no return computed."""

    code = "invalid_reward"


class InvalidState(InvalidInput):
    """Recurrent state that no reply gave, or that belongs to another policy or version."""

    code = "invalid_state"


class BodyTooLarge(InvalidInput):
    """A body, or a batch in it, beyond the limit."""

    code = "body_too_large"


class EnvironmentMismatch(InvalidInput):
    """An environment, script or version that does not fit the league."""

    code = "environment_mismatch"


class NotFound(LeagueError):
    """A thing that was named does not exist."""

    code = "not_found"


class UnknownLeague(NotFound):
    """No league of that name is registered."""

    code = "unknown_league"


class UnknownVersion(NotFound):
    """The league has no ready version of that number."""

    code = "unknown_version"


class VersionRetired(NotFound):
    """A version that was served once and is no more: an episode that is pinned to it cannot go on."""

    code = "version_retired"


class UnknownAlias(NotFound):
    """The league has no alias of that name."""

    code = "unknown_alias"


class UnknownPolicy(NotFound):
    """The version has no policy of that id."""

    code = "unknown_policy"


class UnknownEvaluation(NotFound):
    """The league has no evaluation of that number."""

    code = "unknown_evaluation"


class UnknownRun(NotFound):
    """The league has no training run of that name."""

    code = "unknown_run"


class UnknownVerdict(NotFound):
    """There is no verdict of that id."""

    code = "unknown_verdict"


class UnknownMatch(NotFound):
    """The ledger has no match of that id, or the match no such game."""

    code = "unknown_match"


class UnknownKey(NotFound):
    """There is no API key of that name."""

    code = "unknown_key"


class Conflict(LeagueError):
    """The state is not the one that the caller acted on."""

    code = "conflict"


class AliasMoved(Conflict):
    """A compare-and-set of an alias lost against another."""

    code = "alias_moved"


class InterfaceChanged(Conflict):
    """Spaces or policy ids differ from those of the league's versions."""

    code = "interface_changed"


class LedgerRefusal(Conflict):
    """A match that its schedule did not ask for, or that is not whole."""

    code = "ledger_refusal"


class NothingToRollBack(Conflict):
    """The alias has no earlier version to return to."""

    code = "nothing_to_roll_back"


class NameTaken(Conflict):
    """A name that is to be used once was used."""

    code = "name_taken"


class KeyReused(Conflict):
    """An Idempotency-Key that was used for another call."""

    code = "idempotency_key_reused"


class AlreadyRunning(Conflict):
    """Another process does what only one may do."""

    code = "already_running"


class Unauthenticated(LeagueError):
    """No API key where one is needed, or one that opens nothing."""

    code = "unauthenticated"


class Forbidden(LeagueError):
    """An API key that is not for this."""

    code = "forbidden"


class RateLimited(LeagueError):
    """An API key that calls more often than it may; `wait` is in seconds."""

    code = "rate_limited"

    def __init__(self, message: str, wait: float = 1.0) -> None:
        super().__init__(message)
        self.wait = wait


class Overloaded(LeagueError):
    """More requests at once than a replica takes."""

    code = "overloaded"


class TooManyEvaluations(Overloaded):
    """More evaluations that are queued or running than a server takes."""

    code = "too_many_evaluations"


class DeadlineExceeded(LeagueError):
    """A request that was not answered in the time that it had."""

    code = "deadline_exceeded"


class ArtifactCorrupt(LeagueError):
    """A file of a version is missing or has another digest than its manifest says."""

    code = "artifact_corrupt"


class GameHung(LeagueError):
    """A game of a match that has not ended after `play.max_moves` steps, or `play.game_seconds` of its environment."""

    code = "game_hung"


class BoundExceeded(LeagueError):
    """Returns of a block that differ by more than `gate.return_bound`."""

    code = "bound_exceeded"


class GameCrashed(LeagueError):
    """A game of a match whose environment raised, in a reset or at a legal action."""

    code = "game_crashed"


class VerdictRefuted(LeagueError):
    """A verdict whose record is not what the games in the ledger say."""

    code = "verdict_refuted"


class WorkerLost(LeagueError):
    """The processes that were to do a piece of work died, one after another."""

    code = "worker_lost"


class ParityError(LeagueError):
    """An exported graph does not act as the trained module does."""

    code = "parity_failed"


class NotReady(LeagueError):
    """A policy that exists but is not served (yet)."""

    code = "not_ready"


class NoStudio(NotReady):
    """A server that was deployed without the studio, which plays games."""

    code = "no_studio"


class RemoteError(LeagueError):
    """A policy server that cannot be reached, or that failed."""

    code = "remote_error"


class StorageError(LeagueError):
    """The database or the artefact store cannot be read or written."""

    code = "storage_error"


BY_CODE: dict[str, type[LeagueError]] = {
    error.code: error for error in list(vars().values()) if isinstance(error, type) and issubclass(error, LeagueError)
}
"""What a code that came from another process stands for."""
