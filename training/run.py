"""One training run: Ray Tune trains, the driver publishes each checkpoint as a version."""

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from ray import tune
from rich.console import Console

from league.config import LeagueConfig
from league.environments.building import interface as interface_of
from league.errors import ConfigError, InterfaceChanged
from league.interface import Interface
from league.refs import CheckpointRef
from league.registry.manifest import TRAINING
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.training_config import AnyTraining, TrainingConfig
from training.algorithms.dispatch import algorithm_config, module_spec
from training.algorithms.off_policy import replay_is_lost
from training.chronicle import Chronicle
from training.cluster import UNLIMITED, LocalRay, connected
from training.faults import told
from training.interrupts import Interrupted
from training.pinning import pin
from training.progress import Progress
from training.publish import git_commit
from training.publisher import Publisher, versions
from training.resources import cpu_share, placement
from training.runs import CHECKPOINTS, END, Run
from training.trial import AFRESH, Plan, Start, Trial, read_progress
from training.tuning import Unpickled, fit, quiet, run_config

NETWORK = (
    *("algorithm", "convolutions", "hidden", "recurrence", "normalize_observations", "shared_encoder"),
    *("dueling", "noisy", "distributional"),
    *("mixer", "mixing_width", "groups"),
)
"""Settings that decide what the network is: a version's weights fit no other."""


def train(
    config: LeagueConfig,
    *,
    registry: Registry,
    parent: CheckpointRef | None = None,
    resume: bool = False,
    address: str | None = None,
    local: LocalRay = UNLIMITED,
    config_path: Path | None = None,
    console: Console | None = None,
) -> list[VersionRow]:
    """Train `config` until its budget (`training.steps`, `training.minutes`) is spent.

    Registers the league, runs one Ray Tune trial, shows its progress on `console` (a bar in a terminal, plain lines
    elsewhere), records it in the registry for others to see, writes TensorBoard files below
    `<home>/runs/<league>/<run>` and publishes a version at each checkpoint.

    parent: train on from this version; the first version of the run names it as its parent.
    resume: go on with the newest run of the league, which was interrupted, or has a larger budget now. What it
        published stays, nothing is published twice, and what it had saved but not published yet is published first.
        With a cadence in steps and one runner, its versions are those of a run that was not interrupted.
    address: a running Ray cluster; None takes the Ray that the process is connected to, or starts one within `local`,
        which ends with the run.
    config_path: where `config` was read; its git commit is recorded in the manifests if it lies in a repository.

    Returns the versions of this run, ascending, those of before an interruption included.

    SIGINT or SIGTERM, once: Interrupted, after the run has saved and published where it is. Again: KeyboardInterrupt,
    at once. In both cases the run can be resumed.

    Raises LeagueError: nothing to resume, or with other settings than it began with; an unknown parent, or one of
    another interface or network; opponents that do not exist or fit; a run that another process is on; a cluster whose
    machines do not share storage; a fault of the environment; an export that fails its parity proof (the versions
    published before stay).
    """
    if resume and parent is not None:
        raise ConfigError("a run that is resumed has its parent already: give either --from or --resume")
    quiet()
    interface = interface_of(config)
    check(config, interface)
    registry.register(config, interface)
    number = None if parent is None else _parent(registry, parent, config, interface).number
    interrupted = Run.resume(registry.storage, config) if resume else None
    pins = {} if interrupted else pin(config, registry, interface)
    with connected(address, registry.storage, local) as dashboard:
        run = interrupted or Run.begin(registry.storage, config, number, git_commit(config_path), pins)
        progress = Progress(console or Console(), run.record.config.training, interface.policy_ids)
        with run.locked(), progress, Chronicle(registry, run) as chronicle:
            if dashboard:
                progress.say(f"Ray's dashboard: {dashboard}")
            _work(run, registry, interface, progress, chronicle)
    return versions(registry, run)


def check(config: LeagueConfig, interface: Interface) -> None:
    """Raise ConfigError for settings that do not fit the league or one another, before anything is started."""
    algorithm_config(config, interface)
    module_spec(config.training, interface).build()


def _work(run: Run, registry: Registry, interface: Interface, progress: Progress, chronicle: Chronicle) -> None:
    publisher = Publisher(run, registry, interface, progress)
    try:
        _publish_rest(run, publisher)
        spent = _tune(run, interface, registry, publisher, progress, chronicle)
    except Exception:
        publisher.settle()
        raise
    publisher.settle()
    if not spent:
        published = ", ".join(version.ref for version in versions(registry, run)) or "nothing yet"
        raise Interrupted(f"Ended early. Published: {published}. Curves: {run.path}. To go on: --resume.")
    run.complete()


def _parent(registry: Registry, ref: CheckpointRef, config: LeagueConfig, interface: Interface) -> VersionRow:
    """The version to train on from, which must fit the league and its network."""
    if ref.league != config.league:
        raise ConfigError(f"--from: {ref} is of another league than {config.league}")
    version = registry.resolve(ref)
    if version.manifest.interface.digest() != interface.digest():
        raise InterfaceChanged(f"{version.ref} has other spaces or policies than the environment has now")
    check_network(version, config)
    return version


def check_network(version: VersionRow, config: LeagueConfig) -> None:
    """Raise ConfigError if `config` trains another network than the version has. What its settings do not name yet,
    it has by default."""
    settings: AnyTraining = TypeAdapter(TrainingConfig).validate_python(version.manifest.settings)
    before, now = (part.model_dump(mode="json", by_alias=True) for part in (settings, config.training))
    for key in NETWORK:
        # An algorithm has some of them only.
        if (was := before.get(key)) != (wanted := now.get(key)):
            raise ConfigError(f"training.{key}: {version.ref} was trained with {was}, got {wanted}")


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
    return AFRESH


def _tune(
    run: Run,
    interface: Interface,
    registry: Registry,
    publisher: Publisher,
    progress: Progress,
    chronicle: Chronicle,
) -> bool:
    """One life of the run, as a Tune experiment of one trial. Whether its budget is spent."""
    config, life = run.record.config, run.next_life()
    (life / CHECKPOINTS).mkdir(parents=True)
    share = cpu_share(config.training.runners)
    start = _start(run, registry)
    if start.checkpoint is not None and replay_is_lost(config.training, start.checkpoint):
        progress.say("The replay buffer begins empty: nothing is learned until training.learning_starts transitions.")
    plan = Plan(start, life / CHECKPOINTS, life / END, registry.storage, cpus=share)
    chronicle.begin(start.steps - start.steps_before_run, start.seconds)

    def ask_to_end() -> None:
        plan.end.touch()
        progress.say("Ending after this update, and publishing what there is. Ctrl-C again ends at once.")

    tuner = tune.Tuner(
        tune.with_resources(Trial, placement(config.training, share)),
        param_space={
            "league": config.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "plan": plan,
        },
        tune_config=tune.TuneConfig(trial_dirname_creator=lambda _: life.name),
        run_config=run_config(run.path, [_Driver(publisher, progress, chronicle)], _StopOnError(publisher)),
    )
    result = fit(tuner, ask_to_end)[0]
    if result.error is not None:
        raise told(result.error, config.league, life / "error.txt") from result.error
    return bool((result.metrics or {}).get("spent"))


class _Driver(Unpickled, tune.Callback):
    """Hears each result of the trial, in the driver's process."""

    def __init__(self, publisher: Publisher, progress: Progress, chronicle: Chronicle) -> None:
        self._publisher = publisher
        self._progress = progress
        self._chronicle = chronicle

    def on_trial_result(self, *, result: dict[str, Any], **_: Any) -> None:
        self._progress.update(result)
        self._chronicle.tell(result)
        if "checkpoint" in result:
            self._publisher.add(Path(result["checkpoint"]))


class _StopOnError(Unpickled, tune.Stopper):
    """Ends training when a version cannot be published."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    def __call__(self, *_: Any) -> bool:
        return self.stop_all()

    def stop_all(self) -> bool:
        return self._publisher.error is not None
