"""Does training through the gateway lose, repeat or spoil episodes when its processes are killed?

`league train` runs with simulators in programs of their own, which connect through a server. Each writes the episodes
that it has finished to a file: a number that no other episode has, the number of moves, and the first agent's return.
That agent wins every game; its return contains the number of the episode. A callback of the run writes what training
has counted. Runners are killed while the run continues by itself, and drivers, after which `league train --resume`
continues.

Each episode that training counted must be one that a simulator has finished, of the same length and with the same
returns, and be counted once. An episode that was cut by a kill must never be counted, so that the first agent never
loses. Steps of versions must increase. Episodes that were finished right before a kill, or before a checkpoint resets
all episodes, may not have been counted.
"""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import count
from pathlib import Path
from typing import Any, TextIO

import psutil
import yaml

from benchmarks.harness import Quick, Target
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.settings import Storage
from policy_league_client.simulator import Report, simulate
from tests.support.servers.streaming import listening
from tests.support.simulators import LEAGUE, NAME, VERSION
from tests.support.waiting import until
from training.runs.callbacks import FinishedEpisode

RUNNERS, DRIVERS = 20, 5
"""How often each is killed."""
SIMULATORS, GAMES = 2, 8
CHECKPOINT = 2048
FIRST, SECOND = "first", "second"
COUNTED = "COUNTED_EPISODES"
"""Environment variable with the path of the callback's file."""
SCALE = 2.0**-32
"""Of the number of an episode in its return, which is exact in float64."""
SPAWN = multiprocessing.get_context("spawn")


class WonByTheFirst:
    """A game of some moves in turn. file: where finished episodes are written."""

    def __init__(self, file: TextIO, numbers: Iterator[int]) -> None:
        self._file, self._numbers = file, numbers

    def reset(self, seed: int) -> list[Report]:
        """Begin an episode."""
        self._moves, self._last = 0, 3 + seed % 6
        return [self._report(FIRST)]

    def step(self, actions: Mapping[str, Any]) -> list[Report]:
        """Take a move."""
        assert len(actions) == 1
        self._moves += 1
        if self._moves < self._last:
            return [self._report((FIRST, SECOND)[self._moves % 2])]
        number = next(self._numbers)
        self._file.write(f"{json.dumps([number, self._moves])}\n")
        self._file.flush()
        won = _return(number)
        return [self._report(FIRST, won, terminated=True), self._report(SECOND, -won, terminated=True)]

    def _report(self, agent: str, reward: float = 0.0, terminated: bool = False) -> Report:
        return Report(agent, [self._moves / 8], reward, terminated)


def _return(number: int) -> float:
    """The first agent's return of an episode."""
    return 1 + number * SCALE


class CountedEpisodes:
    """Writes each episode that training has counted."""

    def __init__(self) -> None:
        self._path = Path(os.environ[COUNTED])

    def on_episode(self, episode: FinishedEpisode) -> None:
        """Write an episode."""
        with self._path.open("a") as file:
            file.write(f"{json.dumps([episode.length, episode.returns])}\n")


def play(url: str, key: str, path: Path, first: int) -> None:
    """A simulator. first: the number of its first episode."""
    with path.open("a") as file:
        numbers = count(first)
        make = lambda: WonByTheFirst(file, numbers)  # noqa: E731
        simulate(url, LEAGUE, make, name=NAME, version=VERSION, key=key, episodes=GAMES)


def configuration() -> LeagueConfig:
    """The league."""
    agent = {
        "observation": {"type": "box", "dtype": "float32", "shape": [1], "low": 0, "high": 2},
        "action": {"type": "discrete", "n": 2},
    }
    external = {"simulator": NAME, "version": VERSION, "agents": {FIRST: agent, SECOND: agent}}
    training = {"hidden": [8], "runners": 1, "num_envs": 2 * GAMES, "train_batch_size": 512, "minibatch_size": 256}
    training |= {"epochs": 1, "steps": 10**9, "checkpoint_every": CHECKPOINT}
    training |= {"callbacks": [f"{__name__}:{CountedEpisodes.__name__}"]}
    environment = {"external": external | {"hidden_information": False}}
    return LeagueConfig.from_mapping({"league": LEAGUE, "environment": environment, "training": training})


class Run:
    """A training run, which a driver continues after another one was killed."""

    def __init__(self, folder: Path, registry: Registry) -> None:
        self._folder, self._registry = folder, registry
        self._config = folder / f"{LEAGUE}.yaml"
        self._config.write_text(yaml.safe_dump(configuration().model_dump(mode="json", by_alias=True)))

    def start(self) -> subprocess.Popen[bytes]:
        """Start a driver."""
        command = [sys.executable, "-m", "policy_league", "train", str(self._config)]
        command += ["--resume"] if self.versions() else []
        variables = {"LEAGUE_HOME": str(self._registry.storage.home), COUNTED: str(self._folder / "counted")}
        with (self._folder / "output").open("ab") as output:
            return subprocess.Popen(command, env=os.environ | variables, stdout=output, stderr=output)

    def versions(self) -> list[int]:
        """The steps of the versions, in the order of their publication."""
        return [version.steps for version in self._registry.versions.all(LEAGUE)]

    def wait_for_version(self, driver: subprocess.Popen[bytes]) -> None:
        """Wait until another version was published, without which a run does not continue after a kill."""
        before = len(self.versions())
        until(lambda: len(self.versions()) > before or driver.poll() is not None)
        assert driver.poll() is None, (self._folder / "output").read_text()[-2000:]

    def kill_runner(self, driver: subprocess.Popen[bytes]) -> None:
        """Kill the runner, and wait until it was replaced and a version was published."""
        until(lambda: self._runner(driver))
        victim = self._runner(driver)
        assert victim is not None
        victim.kill()
        until(lambda: self._runner(driver) not in (None, victim))
        self.wait_for_version(driver)

    def _runner(self, driver: subprocess.Popen[bytes]) -> psutil.Process | None:
        processes = psutil.Process(driver.pid).children(recursive=True) if driver.poll() is None else []
        for process in processes:
            try:
                if process.status() != psutil.STATUS_ZOMBIE and "BatchedEnvRunner" in process.cmdline()[0]:
                    return process
            except (psutil.NoSuchProcess, IndexError):
                continue
        return None


@contextmanager
def simulators(folder: Path, registry: Registry) -> Iterator[None]:
    """A server, and simulators in processes of their own."""
    _, key = registry.keys.create("simulators", ["simulate"])
    with listening(registry.storage) as server:
        processes = [
            SPAWN.Process(target=play, args=(server.url, key, folder / f"finished-{number}", number << 24), daemon=True)
            for number in range(SIMULATORS)
        ]
        for process in processes:
            process.start()
        try:
            yield
            assert all(process.is_alive() for process in processes), "a simulator has ended"
        finally:
            for process in processes:
                process.terminate()
                process.join()


def kill(folder: Path, registry: Registry, runners: int, drivers: int) -> list[int]:
    """Kill runners and drivers of a run; returns the steps of its versions."""
    run = Run(folder, registry)
    driver = run.start()
    try:
        for number in range(drivers + 1):
            run.wait_for_version(driver)
            for _ in range(runners * number // drivers, min(runners, runners * (number + 1) // drivers)):
                run.kill_runner(driver)
            if number < drivers:
                driver.kill()
                driver.wait()
                driver = run.start()
        driver.send_signal(signal.SIGINT)
        driver.wait()
        return run.versions()
    finally:
        if driver.poll() is None:
            driver.send_signal(signal.SIGINT)
            driver.wait()


def _lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def main(quick: Quick = False) -> Iterator[Target]:
    """Kill, then compare."""
    runners, drivers = (1, 1) if quick else (RUNNERS, DRIVERS)
    with tempfile.TemporaryDirectory() as name, closing(Registry.open(Storage.at(Path(name) / "home"))) as registry:
        folder, config = Path(name), configuration()
        registry.leagues.register(config, interface(config))
        with simulators(folder, registry):
            steps = kill(folder, registry, runners, drivers)
        counted = _lines(folder / "counted")
        finished = {number: moves for path in folder.glob("finished-*") for number, moves in _lines(path)}
    numbers = [round((returns.get(FIRST, -1.0) - 1) / SCALE) for _, returns in counted]
    wrong = sum(
        finished.get(number) != moves or returns != {FIRST: _return(number), SECOND: -_return(number)}
        for number, (moves, returns) in zip(numbers, counted, strict=True)
    )
    lost = sum(returns.get(FIRST, -1.0) < 1 for _, returns in counted)
    note = f"{len(counted):,} counted, {len(finished):,} finished; {runners} runners and {drivers} drivers killed"
    yield Target("episodes that are not as their simulator finished them", wrong, at_most=0, note=note)
    yield Target("episodes counted twice", sum(Counter(numbers).values()) - len(set(numbers)), at_most=0)
    yield Target("episodes learned as a loss", lost, at_most=0)
    yield Target("versions without further steps", len(steps) - len(set(steps)), at_most=0, note=f"of {len(steps)}")
    uncounted = (len(finished) - len(counted)) / (runners + drivers)
    yield Target("finished episodes that are not counted, per kill", uncounted)
