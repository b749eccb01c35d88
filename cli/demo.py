"""`league demo`: the whole loop once, on connect four, told as it goes."""

import signal
import threading
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from rich.rule import Rule

from cli.board import drawing
from cli.output import console, say
from league.config import LeagueConfig
from league.settings import Storage

LEAGUE = Path("configs/connect_four.yaml")
OPPONENT = "script:one_ply"
VERSIONS = 4
"""How many a demo publishes, whatever the machine's speed."""


def demo(
    minutes: Annotated[float, typer.Option(help="How long to train.")] = 4.0,
    port: Annotated[int, typer.Option(help="Serve on this port of 127.0.0.1.")] = 8000,
    exit_: Annotated[bool, typer.Option("--exit", help="End after the game instead of serving on.")] = False,
) -> None:
    """Train connect four for a few minutes, play the league, promote, serve, and play a game against the champion.

    Everything is kept in LEAGUE_HOME, so that the other commands can go on from there.
    """
    from serve_app.launch import running

    storage = Storage.from_environment()
    storage.export()
    config = LeagueConfig.load(LEAGUE)
    say("Policy League demo: connect four, from self-play to a champion that answers over HTTP.")
    say(f"Everything is kept in {storage.home}.")
    _train(config, minutes)
    _hold_league(config)
    _step(3, f"serve: the champion becomes an action endpoint on 127.0.0.1:{port}, in Ray Serve behind HAProxy.")
    with running(storage, port=port) as url:
        _play(config, url)
        _invite(config.league, url)
        if not exit_:
            say("Serving until Ctrl-C.")
            _wait_for_interrupt()
            say("\nStopping.")


def _train(config: LeagueConfig, minutes: float) -> None:
    from league.registry.registry import Registry
    from training.run import train

    _step(1, f"train: a network plays against itself for {minutes:g} minutes (masked PPO, RLlib, Ray Tune).")
    say("At each checkpoint it is exported to ONNX, proven to act the same, and published as a version.")
    paced = config.with_training(minutes=minutes, checkpoint_minutes=minutes / VERSIONS, checkpoint_every=None)
    train(paced, registry=Registry.open(), config_path=LEAGUE, console=console)


def _hold_league(config: LeagueConfig) -> None:
    from cli.nightly import hold_night

    _step(2, "the league: each new version challenges the champion, in pairs of games with the seats swapped.")
    say("A sequential test (GSPRT) plays until it knows: promote, reject, or undecided.")
    hold_night(config, workers=0)


def _play(config: LeagueConfig, url: str) -> None:
    from evaluation.exhibition import exhibit
    from league.environments.lockstep import stepping
    from league.policies.remote import RemotePolicy
    from league.policies.scripted import script
    from league.refs import ScriptRef
    from league.registry.registry import Registry

    _step(4, f"a game over HTTP: the champion ● moves first, {OPPONENT} ○ answers.")
    interface = Registry.open().league(config.league).interface
    first, second = interface.agents
    spaces = interface.agents[second]
    opponent = script(ScriptRef.parse(OPPONENT).name, spaces.observation, spaces.action)
    environment = stepping(config.environment, copies=1)
    with closing(environment), RemotePolicy(url, config.league) as champion:
        moments = list(exhibit(environment, {first: champion, second: opponent}, seed=config.training.seed))
    moves = [move for moment in moments for move in moment.moves]
    board = next(drawing(e.observation["observation"]) for e in moments[-1].endings if e.agent == 0)
    outcome = moments[-1].returns[first]
    say(f"\n{board}\n")
    say("Moves: " + " ".join(f"{'●' if move.agent == first else '○'}{move.action}" for move in moves))
    say("The champion won." if outcome > 0 else "The champion lost." if outcome < 0 else "A draw.")


def _invite(league: str, url: str) -> None:
    say("")
    console.print(Rule("what to try next", align="left"))
    say(f"Open {url} in a browser: standings, verdicts, games to watch, and")
    say(f"  {url}/leagues/{league}/play    to play against the champion yourself.")
    say("In another terminal, after `source .venv/bin/activate`:")
    say(f"  league act {league}@champion            ask for an action over HTTP")
    say(f"  league versions {league}                versions with aliases and ratings")
    say(f"  league evaluate {league}                a round robin of all versions and scripts")
    say(f"  league promote {league}@1               move the champion by hand; replicas follow within a second")
    say(f"  league history {league}                 who was champion when, and why")
    say(f"  league train {LEAGUE} --from {league}@champion")


def _step(number: int, sentence: str) -> None:
    say("")
    console.print(Rule(f"Step {number} of 4", align="left"))
    say(sentence)


def _wait_for_interrupt() -> None:
    stop = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: stop.set())
    stop.wait()
