"""`league serve` and `league act`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import orjson
import typer

from cli.output import emit, say
from league.errors import ConfigError, InvalidReference
from league.refs import CheckpointRef, PolicyRef, ScriptRef, parse_ref
from league.settings import Storage


def serve(
    host: Annotated[str | None, typer.Option(help="Listen here. Default: what deploy.yaml says, 127.0.0.1.")] = None,
    port: Annotated[int | None, typer.Option(help="Listen here. Default: what deploy.yaml says, 8000.")] = None,
    grpc_port: Annotated[
        int | None, typer.Option(help="gRPC listens here. Default: what deploy.yaml says, 8001.")
    ] = None,
    replicas: Annotated[int | None, typer.Option(help="How many processes answer. Default: deploy.yaml's.")] = None,
    address: Annotated[str | None, typer.Option(help="A running Ray cluster. Default: a local Ray.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Ask nobody for an API key, even where other machines reach the server.")
    ] = False,
) -> None:
    """Serve every league's champion (and any version by number) as an action endpoint, until Ctrl-C.

    `POST /v1/policies/{league}/action` takes an observation and answers with an action. Promotions and rollbacks reach
    every replica within a second, without a restart and without a failed request.

    Who may call is told by API keys (`league keys`). On the loopback interface they are asked for as soon as there is
    one; to listen to other machines (`--host 0.0.0.0`) there must be one.
    """
    from serve_app.launch import serve_forever

    storage = Storage.from_environment()
    storage.export()
    say("Starting Ray Serve …")
    serve_forever(
        storage,
        host=host,
        port=port,
        grpc_port=grpc_port,
        replicas=replicas,
        insecure=insecure,
        address=address,
        on_ready=lambda url: say(
            f"Serving the leagues of {storage.home} on {url}\n"
            f"  {url}                                     the leagues, to look at and to play with in a browser\n"
            f"  {url}/docs                                every call, to try in a browser\n"
            f"  {url}/v1/leagues                          what is served\n"
            f"  {url}/v1/policies/LEAGUE/action           POST an observation, get an action\n"
            f"  {url}/v2/models/LEAGUE                    the Open Inference Protocol, over gRPC too\n"
            "Try: league act connect_four@champion          Stop: Ctrl-C"
        ),
    )


def act(
    ref: Annotated[str, typer.Argument(metavar="REF", help="connect_four@champion, connect_four@3, script:random …")],
    observation: Annotated[
        str | None,
        typer.Option(
            "--observation",
            "-o",
            help="JSON text, a file, or - for stdin: a nested list, or {observation, action_mask}. "
            "Default: the first observation of a fresh episode.",
        ),
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Which policy, where the version has several.")] = None,
    url: Annotated[str, typer.Option(envvar="LEAGUE_URL", help="The policy server.")] = "http://127.0.0.1:8000",
    local: Annotated[bool, typer.Option("--local", help="Load the version here instead of asking a server.")] = False,
    explore: Annotated[bool, typer.Option("--explore", help="Sample an action instead of taking the best.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Makes --explore reproducible.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the whole answer as JSON.")] = False,
) -> None:
    """Ask a policy for one action, from the server that `league serve` started, or --local from the registry."""
    parsed = parse_ref(ref)
    if isinstance(parsed, ScriptRef):
        raise InvalidReference(f"{ref} is a script: only checkpoint versions are served, e.g. connect_four@champion")
    value = _first_observation(parsed, policy) if observation is None else _read(observation)
    answer = (_act_here if local else _ask)(parsed, policy, value, explore, seed, url)
    if as_json:
        emit(answer)
    else:
        say(str(answer["action"]))


def _ask(
    ref: CheckpointRef, policy: str | None, value: Any, explore: bool, seed: int | None, url: str
) -> dict[str, Any]:
    import numpy as np

    from league.client import Client

    model = str(PolicyRef(ref.league, policy))
    with Client(url) as client:
        answer = client.act(f"{model}@{ref.version}", value, explore=explore, seed=seed)
    return {
        "action": np.asarray(answer.action).tolist(),
        "model": model,
        "version": answer.version,
        "sha256": answer.sha256,
    }


def _act_here(
    ref: CheckpointRef, policy: str | None, value: Any, explore: bool, seed: int | None, _: str
) -> dict[str, Any]:
    import numpy as np

    from league.policies.loading import load
    from league.registry.registry import Registry
    from league.seeds import generator
    from serve_app.observations import ObservationReader, refuse_strings

    registry = Registry.open()
    version = registry.resolve(ref)
    loaded = load(version.ref, policy=policy, registry=registry)
    space = version.manifest.policies[policy or next(iter(version.manifest.policies))].observation
    refuse_strings(value)
    observations = ObservationReader(space).read([value])
    # The server draws from the same generator, so that both sample the same action.
    rng = np.random.default_rng() if seed is None else generator(seed, 0)
    actions = loaded.act(observations, explore=explore, rng=[rng] if explore else None)
    return {
        "action": actions.actions[0].tolist(),
        "model": str(PolicyRef(ref.league, policy)),
        "version": version.number,
        "sha256": version.sha256,
    }


def _first_observation(ref: CheckpointRef, policy: str | None) -> Any:
    from evaluation.exhibition import first_observation
    from league.registry.registry import Registry

    league = Registry.open().league(ref.league)
    return first_observation(league.config, league.interface, policy)


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
        raise ConfigError(f"--observation is no JSON: {error}") from error
