"""What is asked for: the document of a request for actions, checked as far as that goes without its policy."""

from dataclasses import dataclass
from typing import Any

from league.errors import BodyTooLarge, InvalidInput, InvalidState
from serve_app.models import version_of
from serve_app.observations import kind
from serve_app.tokens import Token, common_version, read_token

KEYS = frozenset(("observation", "observations", "state", "explore", "seed", "probabilities"))
STREAM_KEYS = KEYS | {"reset", "return_state"}
OBSERVATIONS = ("observation", "observations")


@dataclass(frozen=True, slots=True)
class Ask:
    """A request for actions."""

    observations: list[Any]
    is_batch: bool
    state: dict[str, Any] | None
    """Recurrent state as arrays, still to be read; empty where episodes begin and the reply's state shall be arrays."""
    tokens: list[Token | None] | None
    """Recurrent state as tokens, one for each observation; None where an episode begins."""
    explore: bool
    seed: int | list[int] | None
    probabilities: bool
    strings: int
    """Strings in the document, keys included, apart from those that stand in the observations."""


def read_ask(document: dict[str, Any], max_batch: int) -> Ask:
    """Check a document that has no other keys than KEYS. Raises BodyTooLarge, InvalidInput or InvalidState."""
    is_batch = "observations" in document
    if is_batch == ("observation" in document):
        both = "both observation and observations" if is_batch else "neither observation nor observations"
        raise InvalidInput(f"the body has {both}, expected one of them")
    observations = document["observations"] if is_batch else [document["observation"]]
    if is_batch:
        _check_batch(observations, max_batch)
    explore, probabilities = read_flag(document, "explore"), read_flag(document, "probabilities")
    seed = document.get("seed")
    _check_seed(seed, len(observations) if is_batch else None)
    arrays, tokens, strings = None, None, len(document)
    if (state := document.get("state")) is not None:
        if type(state) is dict:
            arrays, strings = state, strings + len(state)
        else:
            tokens = _tokens(state, len(observations) if is_batch else None)
            strings += sum(token is not None for token in tokens)
    return Ask(observations, is_batch, arrays, tokens, explore, seed, probabilities, strings)


def refuse_unknown(document: dict[str, Any], known: frozenset[str]) -> None:
    """Raise InvalidInput if a document has another key."""
    if not document.keys() <= known:
        unknown = min(document.keys() - known)
        raise InvalidInput(f"the body has the unknown key {unknown[:64]!r}, expected {', '.join(sorted(known))}")


def read_flag(document: dict[str, Any], key: str) -> bool:
    """A boolean of a document, by default false. Raises InvalidInput."""
    flag = document.get(key, False)
    if type(flag) is not bool:
        raise InvalidInput(f"{key} is {kind(flag)}, expected true or false")
    return flag


def pinned_version(ask: Ask, model: str, asked: str) -> str:
    """The version of `model` that must answer: that of the state's tokens, else the one that is `asked` for.

    Raises InvalidState if both are named and differ, or if a token is of another league, whose versions are others. An
    alias contradicts nothing: it moves, and episodes stay.
    """
    tokens = [token for token in ask.tokens or () if token is not None]
    if not tokens:
        return asked
    league = model.partition(".")[0]
    for token in tokens:
        if token.model.partition(".")[0] != league:
            raise InvalidState(f"state is of {token.model[:64]}, not of {model[:64]}")
    version = common_version(tokens)
    if version_of(asked) not in (version, asked):
        raise InvalidState(
            f"state is of version {version}, and version {asked} is asked for: an episode stays at its own"
        )
    return str(version)


def _tokens(state: Any, batch: int | None) -> list[Token | None]:
    if batch is None:
        return [read_token(state)]
    if type(state) is not list:
        raise InvalidState(f"state is {kind(state)}, expected a list: the state of each observation, or null")
    if len(state) != batch:
        raise InvalidState(f"state holds {len(state)}, expected {batch}: one for each observation, or null")
    return [None if each is None else read_token(each) for each in state]


def _check_seed(seed: Any, batch: int | None) -> None:
    if seed is None:
        return
    if batch is not None and type(seed) is list and len(seed) != batch:
        raise InvalidInput(f"seed holds {len(seed)} integers, expected {batch}: one per observation")
    seeds = seed if batch is not None and type(seed) is list else [seed]
    if any(type(each) is not int or not 0 <= each < 2**63 for each in seeds):
        raise InvalidInput("seed must be null or an integer from 0 to 2^63 - 1, or in a batch a list of such integers")


def _check_batch(observations: Any, max_batch: int) -> None:
    if type(observations) is not list:
        raise InvalidInput(f"observations is {kind(observations)}, expected a list of observations")
    if not observations:
        raise InvalidInput("observations is empty, expected at least one")
    if len(observations) > max_batch:
        raise BodyTooLarge(f"observations holds {len(observations)}, expected at most {max_batch}")
