"""An action request: parsed and checked, executed, and encoded as a response."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any, NamedTuple

from numpy.typing import NDArray

from league.errors import BodyTooLarge, InvalidInput, InvalidState
from league.policies.draws import probabilities
from league.policies.policy import Arrays
from league.search.searched_actions import SearchedActions
from league.spaces import ACTION_MASK
from league.spaces.observation_codec import json_type
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.codecs.state_tokens import StateToken, common_version, read_state, read_token, write_tokens
from serve_app.inference.batches import Answer
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy
from serve_app.live_versions.resolver import version_of

KEYS = frozenset(
    ("observation", "observations", "state", "explore", "seed", "probabilities", "deadline_ms", "analysis")
)
OBSERVATIONS = ("observation", "observations")
MOST_MS = 24 * 60 * 60 * 1000
"""The longest time limit of a search, in milliseconds."""


@dataclass(slots=True)
class DecodedActionRequest:
    """A request for actions."""

    observations: list[Any]
    is_batch: bool
    tokens: list[StateToken | None] | None
    """Recurrent state as tokens, one per observation; None at the start of an episode."""
    options: ActionOptions
    strings: int
    """Number of strings in the document, including keys, except those in the observations."""
    booleans: int
    """Likewise of booleans."""


DEFAULT = ActionOptions()


def parse_action_request(document: dict[str, Any], max_batch: int) -> DecodedActionRequest:
    """Parse a document that has no keys other than KEYS. Raises BodyTooLarge, InvalidInput or InvalidState."""
    is_batch = "observations" in document
    if is_batch == ("observation" in document):
        both = "both observation and observations" if is_batch else "neither observation nor observations"
        raise InvalidInput(f"the body has {both}, expected one of them")
    observations = document["observations"] if is_batch else [document["observation"]]
    if type(observations) is not list:
        raise InvalidInput(f"observations is {json_type(observations)}, expected a list of observations")
    if not observations:
        raise InvalidInput("observations is empty, expected at least one")
    if len(observations) > max_batch:
        raise BodyTooLarge(f"observations has {len(observations)} items, expected at most {max_batch}")
    if len(document) == 1:
        return DecodedActionRequest(observations, is_batch, None, DEFAULT, 1, 0)
    explore = parse_flag(document, "explore") if "explore" in document else None
    probabilities = parse_flag(document, "probabilities")
    analysis, deadline = parse_flag(document, "analysis"), _deadline(document.get("deadline_ms"))
    seed = document.get("seed")
    _check_seed(seed, len(observations) if is_batch else None)
    tokens, strings = None, len(document)
    if (state := document.get("state")) is not None:
        tokens = _tokens(state, len(observations) if is_batch else None)
        strings += sum(token is not None for token in tokens)
    options = ActionOptions(explore, seed, "distribution" if probabilities else None, deadline, analysis)
    booleans = sum(type(value) is bool for value in document.values())
    return DecodedActionRequest(observations, is_batch, tokens, options, strings, booleans)


def reject_unknown_keys(document: dict[str, Any], known: frozenset[str]) -> None:
    """Raise InvalidInput if a document has a key that is not in `known`."""
    if not document.keys() <= known:
        unknown = min(document.keys() - known)
        raise InvalidInput(f"the body has the unknown key {unknown[:64]!r}, expected {', '.join(sorted(known))}")


def parse_flag(document: dict[str, Any], key: str) -> bool:
    """A boolean of a document, false by default. Raises InvalidInput."""
    flag = document.get(key, False)
    if type(flag) is not bool:
        raise InvalidInput(f"{key} is {json_type(flag)}, expected true or false")
    return flag


def pinned_version(request: DecodedActionRequest, model: str, requested: str, members: Collection[int] = ()) -> str:
    """The version of `model` that must answer: that of the state tokens, otherwise the requested one.

    members: of the requested version, if that is a mixture.

    Raises InvalidState if the two differ, or if a token belongs to another league. An alias never conflicts with a
    token, because aliases move while episodes stay with their version.
    """
    tokens = [token for token in request.tokens or () if token is not None]
    if not tokens:
        return requested
    league = model.partition(".")[0]
    for token in tokens:
        if token.model.partition(".")[0] != league:
            raise InvalidState(f"state is of {token.model[:64]}, expected {model[:64]}")
    version = common_version(tokens)
    if version_of(requested) not in (version, requested) and version not in members:
        raise InvalidState(
            f"state is of version {version}, but the request is for version {requested}: an episode stays with one"
            " version"
        )
    return str(version)


def _tokens(state: Any, batch: int | None) -> list[StateToken | None]:
    if batch is None:
        return [read_token(state)]
    if type(state) is not list:
        raise InvalidState(f"state is {json_type(state)}, expected a list with the state of each observation, or null")
    if len(state) != batch:
        raise InvalidState(f"state has {len(state)} items, expected {batch}: one per observation")
    return [None if token is None else read_token(token) for token in state]


def _check_seed(seed: Any, batch: int | None) -> None:
    if seed is None:
        return
    if batch is not None and type(seed) is list and len(seed) != batch:
        raise InvalidInput(f"seed has {len(seed)} integers, expected {batch}: one per observation")
    seeds = seed if batch is not None and type(seed) is list else [seed]
    if any(type(row_seed) is not int or not 0 <= row_seed < 2**63 for row_seed in seeds):
        raise InvalidInput("seed must be null or an integer from 0 to 2^63 - 1, or in a batch a list of such integers")


def _deadline(milliseconds: Any) -> float:
    if milliseconds is None:
        return math.inf
    if type(milliseconds) is not int or not 0 < milliseconds <= MOST_MS:
        raise InvalidInput(f"deadline_ms must be null or an integer from 1 to {MOST_MS}")
    return monotonic() + milliseconds / 1000


class JsonObservations(NamedTuple):
    """See `RequestRows`."""

    observations: list[Any]
    is_plain: bool
    """Whether no value is a string."""
    is_joinable: bool
    is_large: bool

    @property
    def rows(self) -> int:
        """See `RequestRows`."""
        return len(self.observations)

    @staticmethod
    def read(policy: LoadedPolicy, parts: Sequence["JsonObservations"]) -> Arrays:
        """See `RequestRows`. Raises ObservationError, IllegalMask or BodyTooLarge."""
        if len(parts) == 1:
            return policy.reader.read(parts[0].observations, parts[0].is_plain)
        return policy.reader.read([value for part in parts for value in part.observations], True, is_mixed=True)


def json_observations(
    request: DecodedActionRequest, policy: LoadedPolicy, body: bytes, strings: int = 0
) -> JsonObservations:
    """The observations of a request, in a body with `strings` further strings. Raises BodyTooLarge."""
    observations = request.observations
    policy.limits.check_size(len(body), len(observations))
    # Two quotation marks per string. More strings than keys mean that a key is wrong or a leaf is base64.
    is_plain = body.count(b'"') == 2 * (request.strings + strings + len(observations) * policy.reader.keys)
    is_large = len(body) > LARGE_BODY
    # In one array with numbers of other requests, booleans would become numbers.
    is_joinable = is_plain and not is_large and body.count(b"true") + body.count(b"false") == request.booleans
    return JsonObservations(observations, is_plain, is_joinable, is_large)


def decode_state(request: DecodedActionRequest, policy: LoadedPolicy) -> Arrays | None:
    """Decode the recurrent state of the request. Raises InvalidState."""
    if request.tokens is None or not any(request.tokens):
        return None
    if not policy.state:
        raise InvalidState("state must be null: this policy is not recurrent")
    return read_state(request.tokens, policy.qualified, policy.sha256, policy.state)


def encode_state(state: dict[str, NDArray], policy: LoadedPolicy) -> list[str]:
    """Encode a state as tokens."""
    return write_tokens(policy.qualified, policy.number, policy.sha256, state)


def build_response(request: DecodedActionRequest, answer: Answer, policy: LoadedPolicy) -> dict[str, Any]:
    """The response's `action` or `actions`, its `probabilities`, and what is known from a search."""
    output, actions = answer.output, answer.actions.tolist()
    response: dict[str, Any] = {"actions": actions} if request.is_batch else {"action": actions[0]}
    if isinstance(output, SearchedActions):
        rows: dict[str, list[Any]] = {"simulations": output.simulations()}
        if request.options.analysis:
            rows["analysis"] = output.analyses()
        response |= rows if request.is_batch else {name: values[0] for name, values in rows.items()}
    if request.options.values:
        assert answer.dist_inputs is not None
        # An action that is certain has the probability 1 even if it is illegal.
        mask = answer.inputs.get(ACTION_MASK) if policy.graph.has_distribution else None
        likely = probabilities(answer.dist_inputs, policy.manifest.action, mask)
        response["probabilities"] = likely if request.is_batch else likely[0]
    return response
