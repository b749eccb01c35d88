"""`league act`."""

import sys
import time
from dataclasses import asdict
from pathlib import Path
from secrets import token_hex
from typing import Annotated, Any

import orjson
import typer

from league.errors import (
    ConfigError,
    InvalidInput,
    InvalidReference,
    RemoteError,
    StorageError,
    UnknownLeague,
    one_line,
)
from league.refs import CHAMPION, CheckpointRef, PolicyRef, RemoteRef, ScriptRef, parse_ref
from policy_league.cli.options import DEFAULT_URL, MAX_SEED, open_registry
from policy_league.cli.output import emit, say


def act(
    ref: Annotated[str, typer.Argument(metavar="REF", help="connect_four, connect_four@3, connect_four@candidate …")],
    observation: Annotated[
        str | None,
        typer.Option(
            "--observation",
            "-o",
            help="Observation as JSON text, a file, or - for stdin: a nested list, or {observation, action_mask}. "
            "Default: the first observation of a new episode.",
        ),
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Policy ID, if the version has several policies.")] = None,
    url: Annotated[str, typer.Option(envvar="LEAGUE_URL", help="URL of the policy server.")] = DEFAULT_URL,
    local: Annotated[
        bool, typer.Option("--local", help="Load the version in this process instead of calling a server.")
    ] = False,
    explore: Annotated[
        bool | None,
        typer.Option("--explore/--greedy", help="Sample an action, or take the greedy one. Default: as in matches."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=MAX_SEED, help="Random seed for a sampled action.")] = None,
    deadline_ms: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="MS", help="A search version plays the best action after this time. Default: none."
        ),
    ] = None,
    analysis: Annotated[bool, typer.Option("--analysis", help="Print what a search version expects, as JSON.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the complete response as JSON.")] = False,
) -> None:
    """Request one action from a policy server, or compute it locally."""
    parsed: CheckpointRef | ScriptRef | RemoteRef
    if "@" in ref or ":" in ref:
        parsed = parse_ref(ref)
    else:  # as over HTTP, LEAGUE or LEAGUE.POLICY stands for the champion
        model = PolicyRef.parse(ref)
        parsed, policy = CheckpointRef(model.league, CHAMPION), policy or model.policy
    if not isinstance(parsed, CheckpointRef):
        raise InvalidReference(f"{ref} is not a version. Only versions can be served, such as connect_four@champion")
    value = _first_observation(parsed.league, policy, local) if observation is None else _read(observation)
    options = {"explore": explore, "seed": seed, "deadline_ms": deadline_ms, "analysis": analysis}
    response = _act_here(parsed, policy, value, options) if local else _ask(parsed, policy, value, options, url)
    if as_json or analysis:
        emit(response)
    else:
        say(str(response["action"]))


def _first_observation(league: str, policy: str | None, local: bool) -> Any:
    """The first observation of a new episode, which requires the league's environment on this machine."""
    from evaluation.playback.single_game import first_observation

    try:
        row = open_registry(create=local).leagues.get(league)
    except (StorageError, UnknownLeague) as error:
        if local:
            raise
        raise InvalidInput(
            f"pass --observation: the first one of an episode can be computed only where the league is, and"
            f" {one_line(error)}"
        ) from error
    return first_observation(row.config, row.interface, policy)


def _ask(ref: CheckpointRef, policy: str | None, value: Any, options: dict[str, Any], url: str) -> dict[str, Any]:
    import httpx
    import numpy as np

    from policy_league_client import Client

    model = str(PolicyRef(ref.league, policy))
    try:
        with Client(url) as client:
            response = client.act(f"{model}@{ref.version}", value, **options)
    except RemoteError as error:
        if not isinstance(error.__cause__, httpx.ConnectError):
            raise
        raise RemoteError(
            f"{error}; `league serve` starts a server, --url names another, --local needs none"
        ) from error
    action, analysis = np.asarray(response.action), None if response.analysis is None else asdict(response.analysis)
    return _document(action, model, response.version, response.sha256, response.simulations, analysis)


def _act_here(ref: CheckpointRef, policy: str | None, value: Any, options: dict[str, Any]) -> dict[str, Any]:
    import numpy as np

    from league.policies.loading import acting_version, policy_id
    from league.random.seeds import generator
    from league.search.policies import SearchPolicy, contestant
    from league.search.searched_actions import MOVES, SearchedActions
    from league.spaces.observation_codec import ObservationReader, reject_strings

    registry = open_registry()
    version = acting_version(registry.versions.resolve(ref), registry, token_hex())
    league = registry.leagues.get(ref.league)
    name, interface = policy_id(version, policy), version.manifest.interface
    players = contestant(version.ref, registry, interface, league.config.environment)
    player = dict(players.values())[name]
    limits: dict[str, Any] = {}
    if isinstance(player, SearchPolicy):
        if options["deadline_ms"] is not None:
            limits["deadline"] = time.monotonic() + options["deadline_ms"] / 1000
        limits["moves"] = MOVES if options["analysis"] else 0
    elif options["analysis"]:
        raise InvalidInput(f"--analysis: {version.ref} does not search")
    reject_strings(value)
    observations = ObservationReader(interface.of_policy(name).observation).read([value])
    # The same generator as on the server, so that both sample the same action.
    rng = [np.random.default_rng() if options["seed"] is None else generator(options["seed"], 0)]
    is_sampled = league.conditions.actions == "sampled" if options["explore"] is None else options["explore"]
    actions = player.act(observations, explore=is_sampled, rng=rng, **limits)
    simulations = analysis = None
    if isinstance(actions, SearchedActions):
        simulations, analysis = actions.simulations()[0], actions.analyses()[0] if options["analysis"] else None
    model = str(PolicyRef(ref.league, policy))
    return _document(actions.actions[0], model, version.number, version.sha256, simulations, analysis)


def _document(
    action: Any, model: str, version: int, sha256: str, simulations: int | None, analysis: Any
) -> dict[str, Any]:
    searched = {"simulations": simulations, "analysis": analysis}
    document = {"action": action.tolist(), "model": model, "version": version, "sha256": sha256}
    return document | {name: value for name, value in searched.items() if value is not None}


def _read(observation: str) -> Any:
    if observation == "-":
        text = sys.stdin.read()
    elif observation.lstrip()[:1] in ("[", "{"):
        text = observation
    else:
        try:
            text = Path(observation).read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"--observation: {observation}: {error.strerror}") from error
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise ConfigError(f"--observation is not valid JSON: {error}") from error
