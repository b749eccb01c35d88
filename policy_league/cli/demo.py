"""`league demo`: train, evaluate, promote and serve Connect Four, with explanations."""

import threading
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Annotated

import typer
from rich.rule import Rule

from league.interruption import on_ending_signals
from league.settings import Storage
from policy_league.cli.options import DEFAULT_URL, open_registry
from policy_league.cli.output import console, say
from policy_league.cli.training.options import PRELOADED
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from league.config.league import LeagueConfig

LEAGUE = "connect_four"
OPPONENT = "script:one_ply"
TEACHER = {"ref": "script:minimax_4", "weight": {"initial": 1.0, "final": 0.1}}
"""As in the league's configuration, but the weight decreases over the time of the demo."""
VERSIONS = 4
"""Number of versions that the demo publishes, regardless of the speed of the machine."""
MARKS = ("●", "○")
EMPTY = "·"


def demo(
    minutes: Annotated[float, typer.Option(help="Training time in minutes.")] = 4.0,
    port: Annotated[int, typer.Option(help="HTTP port of the server on 127.0.0.1.")] = 8000,
    grpc_port: Annotated[int, typer.Option(help="gRPC port of the server; 0 selects a free one.")] = 0,
    exit_: Annotated[bool, typer.Option("--exit", help="Exit after the game instead of serving until Ctrl-C.")] = False,
) -> None:
    """Train, evaluate and serve Connect Four, then play a game against it.

    The results are stored in LEAGUE_HOME and can be used with all other commands.
    """
    from league.config.league import LeagueConfig
    from policy_league.cli.evaluation.nightly import run_night
    from serve_app.runtime.launch import running

    storage = Storage.from_environment()
    storage.export()
    config = LeagueConfig.load(find(LEAGUE))
    say("Policy League demo: Connect Four, from self-play training to a champion served over HTTP.")
    say(f"Data is stored in {storage.home}.")
    _train(config, minutes)
    _step(2, "Evaluate: each new version plays the champion in pairs of games with sides swapped.")
    say("A sequential test (GSPRT) decides when to stop: promote, reject or undecided.")
    run_night(config, workers=0)
    _step(3, f"Serve: Ray Serve and HAProxy serve the champion on 127.0.0.1:{port}.")
    with running(storage, port=port, grpc_port=grpc_port) as url:
        _play(config, url)
        if exit_:
            _show_next_steps(config.league, url, f"`league serve --port {port}` starts the server again.")
        else:
            _show_next_steps(config.league, url)
            say("Serving until Ctrl-C.")
            with on_ending_signals(), suppress(KeyboardInterrupt):
                threading.Event().wait()
            say("\nStopping.")


def _train(config: "LeagueConfig", minutes: float) -> None:
    from league.ray_cluster import LocalRay, connected

    _step(1, f"Train for {minutes:g} minutes by masked PPO (RLlib, Ray Tune): self-play, and games against {OPPONENT}.")
    say(f"The policy also imitates {TEACHER['ref']}, a search to a depth of four moves, most of all at first.")
    say("Each checkpoint is exported to ONNX, tested for identical actions, and published as a version.")
    paced = config.with_training(minutes=minutes, checkpoint_minutes=minutes / VERSIONS, teacher=TEACHER)
    registry = open_registry()
    with connected(None, registry.storage, LocalRay(preload=PRELOADED)):
        from evaluation.service.strength_process import StrengthProcess
        from training.runs.train import train

        with closing(StrengthProcess(registry.storage)) as measure:
            train(paced, registry=registry, config_path=find(LEAGUE), console=console, measure=measure)


def _play(config: "LeagueConfig", url: str) -> None:
    from evaluation.playback.single_game import play_game
    from league.environments.implementation import stock_stepping
    from league.policies.open_inference import remote_policies
    from league.policies.scripted import script
    from league.refs import RemoteRef, ScriptRef

    _step(4, f"Play a game over HTTP: the champion ● moves first against {OPPONENT} ○.")
    interface = open_registry().leagues.get(config.league).interface
    first, second = interface.agents
    spaces = interface.agents[second]
    opponent = script(ScriptRef.parse(OPPONENT).name, spaces.observation, spaces.action)
    (champion,) = remote_policies(RemoteRef(url, config.league), interface).values()
    with closing(champion), closing(stock_stepping(config.environment, num_envs=1)) as environment:
        steps = list(play_game(environment, {first: champion, second: opponent}, seed=config.training.seed))
    moves = [move for step in steps for move in step.moves]
    board = next(drawing(e.observation["observation"]) for e in steps[-1].endings if e.agent == 0)
    outcome = steps[-1].returns[first]
    played = " ".join(f"{'●' if move.agent == first else '○'}{move.action}" for move in moves)
    end = "The champion won." if outcome > 0 else "The champion lost." if outcome < 0 else "A draw."
    say(f"\n{board}\n\nMoves: {played}\n{end}")


def drawing(planes: "NDArray") -> str:
    """Draw a board from its planes (rows, columns, 2), ● in the first and ○ in the second."""
    rows = [" ".join(_mark(square) for square in row) for row in planes]
    columns = " ".join(str(column) for column in range(planes.shape[1]))
    return "\n".join([*rows, columns])


def _mark(square: "NDArray") -> str:
    return next((mark for mark, there in zip(MARKS, square, strict=True) if there), EMPTY)


def _show_next_steps(league: str, url: str, first: str = "") -> None:
    say("")
    console.print(Rule("Next steps", align="left"))
    lines = (
        first,
        f"Open {url} in a browser for the leaderboard, verdicts and recorded games, and",
        f"  {url}/leagues/{league}/play    to play against the champion.",
        "In another terminal, after `source .venv/bin/activate`:",
        "" if url == DEFAULT_URL else f"  export LEAGUE_URL={url}",
        f"  league act {league}@champion            request an action over HTTP",
        f"  league versions {league}                list versions with aliases and ratings",
        f"  league evaluate {league}                play a round robin of all versions and scripts",
        f"  league promote {league}@1               change the champion; replicas follow within a second",
        f"  league history {league}                 show past champions and the reasons for the changes",
        f"  league train {LEAGUE} --from {league}@champion",
    )
    say("\n".join(filter(None, lines)))


def _step(number: int, sentence: str) -> None:
    say("")
    console.print(Rule(f"Step {number} of 4", align="left"))
    say(sentence)
