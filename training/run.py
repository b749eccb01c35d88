"""One training run: Ray Tune trains, the driver publishes each checkpoint as a version."""

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray import tune
from rich.console import Console

from league.config import LeagueConfig
from league.environments.building import interface as interface_of
from league.errors import ConfigError, InterfaceChanged, LeagueError
from league.interface import Interface
from league.refs import CheckpointRef
from league.registry.manifest import TRAINING
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from training.algorithms.ppo import module_spec
from training.cluster import connected
from training.progress import Progress
from training.publish import git_commit
from training.publisher import Publisher, versions
from training.runs import CHECKPOINTS, Run
from training.trial import Start, Trial, read_progress


def train(
    config: LeagueConfig,
    *,
    registry: Registry,
    parent: CheckpointRef | None = None,
    resume: bool = False,
    address: str | None = None,
    config_path: Path | None = None,
    console: Console | None = None,
) -> list[VersionRow]:
    """Train `config` until its budget (`training.steps`, `training.minutes`) is spent.

    Registers the league, runs one Ray Tune trial, shows its progress on `console` (live in a terminal, plain lines
    elsewhere), writes TensorBoard files below `<home>/runs/<league>/<run>` and publishes a version at each checkpoint.

    parent: train on from this version; the first version of the run names it as its parent.
    resume: go on with the newest run of the league, which was interrupted. What it published stays, nothing is
        published twice, and what it had saved but not published yet is published first.
    address: a running Ray cluster; None takes the Ray that the process is connected to, or starts a local one, which
        ends with the run.
    config_path: where `config` was read; its git commit is recorded in the manifests if it lies in a repository.

    Returns the versions of this run, ascending, those of before an interruption included.

    Raises LeagueError: nothing to resume, or with other settings than it began with; an unknown parent, or one of
    another interface or network; a run that another process is on; a cluster whose machines do not share storage; an
    export that fails its parity proof (the versions published before stay). KeyboardInterrupt leaves a run that can be
    resumed.
    """
    if resume and parent is not None:
        raise ConfigError("a run that is resumed has its parent already: give either --from or --resume")
    _quiet()
    interface = interface_of(config)
    module_spec(config.training, interface).build()  # what does not fit fails here, before anything is started
    registry.register(config, interface)
    number = None if parent is None else _parent(registry, parent, config, interface).number
    interrupted = Run.resume(registry.storage, config) if resume else None
    with connected(address, registry.storage):
        run = interrupted or Run.begin(registry.storage, config, number, git_commit(config_path))
        with run.locked(), Progress(console or Console(), config.training, interface.policy_ids) as progress:
            _work(run, registry, interface, progress)
    return versions(registry, run)


def _work(run: Run, registry: Registry, interface: Interface, progress: Progress) -> None:
    publisher = Publisher(run, registry, interface, progress)
    try:
        _publish_rest(run, publisher)
        _tune(run, interface, _start(run, registry), publisher, progress)
    finally:
        publisher.settle()
    run.complete()


def _parent(registry: Registry, ref: CheckpointRef, config: LeagueConfig, interface: Interface) -> VersionRow:
    """The version to train on from, which must fit the league and its network."""
    if ref.league != config.league:
        raise ConfigError(f"--from: {ref} is of another league than {config.league}")
    version = registry.resolve(ref)
    if version.manifest.interface.digest() != interface.digest():
        raise InterfaceChanged(f"{version.ref} has other spaces or policies than the environment has now")
    now = config.training.model_dump(mode="json", by_alias=True)
    for key in ("algorithm", "convolutions", "hidden"):
        if (before := version.manifest.settings.get(key)) != now[key]:
            raise ConfigError(f"training.{key}: {version.ref} was trained with {before}, got {now[key]}")
    return version


def _publish_rest(run: Run, publisher: Publisher) -> None:
    """Publish what earlier lives of the run had saved, then clear it away."""
    for checkpoint in run.checkpoints():
        publisher.add(checkpoint)
    publisher.settle()
    run.forget_checkpoints()


def _start(run: Run, registry: Registry) -> Start:
    """The state to train on from: the run's newest version, else its parent, else none."""
    parent, league = run.record.parent, run.record.config.league
    before = registry.version(league, parent).steps if parent is not None else 0
    published = versions(registry, run)
    if published:
        state = registry.fetch(league, published[-1].number) / TRAINING
        steps, seconds = read_progress(state)
        return Start(state, steps, before, seconds)
    if parent is not None:
        return Start(registry.fetch(league, parent) / TRAINING, before, before, 0.0)
    return Start(None, 0, 0, 0.0)


def _tune(run: Run, interface: Interface, start: Start, publisher: Publisher, progress: Progress) -> None:
    """One life of the run, as a Tune experiment of one trial."""
    config, life = run.record.config, run.next_life()
    checkpoints = life / CHECKPOINTS
    checkpoints.mkdir(parents=True)
    share = _cpu_share(config.training.runners)
    tuner = tune.Tuner(
        tune.with_resources(Trial, _resources(config.training.runners, share)),
        param_space={
            "league": config.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "start": start,
            "checkpoints": checkpoints,
            "runner_cpus": share,
        },
        tune_config=tune.TuneConfig(trial_dirname_creator=lambda _: life.name),
        run_config=tune.RunConfig(
            name=run.id,
            storage_path=str(run.path.parent),
            callbacks=[_Driver(publisher, progress)],
            stop=_StopOnError(publisher),
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            verbose=0,
        ),
    )
    with _signals_as_before():
        result = tuner.fit()[0]
    if result.error is not None:
        raise _cause(result.error)
    if publisher.error is None and not (result.metrics or {}).get("done"):
        raise KeyboardInterrupt


@contextmanager
def _signals_as_before() -> Iterator[None]:
    """Tune leaves its handler of Ctrl-C behind, which would swallow the next one."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGUSR1)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _quiet() -> None:
    """The progress is ours: none of Tune's tables, hints and traces, nor RLlib's deprecations of its own calls.
    And the trial stays in this directory, where a user's own environment is importable."""
    os.environ["RAY_CHDIR_TO_TRIAL_DIR"] = "0"
    os.environ["RAY_AIR_NEW_OUTPUT"] = "0"
    logging.getLogger("ray._common.deprecation").setLevel(logging.ERROR)
    os.environ["TUNE_PRINT_ALL_TRIAL_ERRORS"] = "0"
    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)


class _Unpickled:
    """Tune pickles what it is given, for a way of resuming that is not ours: nothing of the driver goes into it."""

    def __getstate__(self) -> dict[str, Any]:
        return {}


class _Driver(_Unpickled, tune.Callback):
    """Hears each result of the trial, in the driver's process."""

    def __init__(self, publisher: Publisher, progress: Progress) -> None:
        self._publisher = publisher
        self._progress = progress

    def on_trial_result(self, *, result: dict[str, Any], **_: Any) -> None:
        self._progress.update(result)
        if "checkpoint" in result:
            self._publisher.add(Path(result["checkpoint"]))


class _StopOnError(_Unpickled, tune.Stopper):
    """Ends training when a version cannot be published."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    def __call__(self, *_: Any) -> bool:
        return self.stop_all()

    def stop_all(self) -> bool:
        return self._publisher.error is not None


def _cpu_share(runners: int) -> float:
    """CPUs of the learner and of each runner: one, less where there are not as many.

    They take turns, so that a machine is not overloaded by a few more of them than it has CPUs.
    """
    cpus = ray.cluster_resources().get("CPU", 1.0)
    return min(1.0, int(100 * cpus / (1 + runners)) / 100)


def _resources(runners: int, share: float) -> tune.PlacementGroupFactory:
    """The learner on the driver's machine, where checkpoints are read; each runner anywhere."""
    here = f"node:{ray.util.get_node_ip_address()}"
    return tune.PlacementGroupFactory([{"CPU": share, here: 0.001}] + [{"CPU": share}] * runners)


def _cause(error: BaseException) -> BaseException:
    """The fault of a person behind an error of Ray's, if it is one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, LeagueError):
            return cause
        cause = getattr(cause, "cause", None) or cause.__cause__
    return error
