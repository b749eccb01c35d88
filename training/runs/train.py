"""Runs one training run: Ray Tune trains, and the driver publishes each checkpoint as a version."""

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from ray import tune
from rich.console import Console

from league.conditions import describe_selection
from league.config.league import LeagueConfig
from league.environments.building import describe_policies
from league.environments.building import interface as interface_of
from league.environments.implementation import implementation
from league.errors import ConfigError, LeagueError, UnknownRun, one_line
from league.interface import Interface
from league.policies.loading import check_contestants, check_eligible
from league.ray_cluster import UNLIMITED, LocalRay, check_nodes, cluster_cpus, connected, lost_nodes, node_ids
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MAIN, TRAINING, Role
from league.registry.storage.rows import VersionRow
from training.algorithms.off_policy import starts_with_empty_replay
from training.algorithms.rllib_config import algorithm_config, module_spec, num_envs
from training.export.publish import git_commit
from training.rllib_compat import NotPickled, silence_tune
from training.runs.driver_files import driver_machine
from training.runs.error_messages import is_process_lost, training_error
from training.runs.node_watch import NodeWatch
from training.runs.parent import parent_version
from training.runs.progress import TrainingProgress
from training.runs.publish_queue import PublishQueue, published_versions
from training.runs.run_directory import CHECKPOINTS, OWN_ID, START, STOP_FILE, RunDirectory, pin_opponents
from training.runs.run_reporter import RunReporter
from training.runs.strength_queue import Measure, StrengthQueue
from training.runs.trial import FROM_SCRATCH, StartState, Trial, TrialPlan, read_progress
from training.runs.tune import Interrupted, cpu_share, fit, placement, run_config

NODE_LOSS_TIMEOUT = 45.0
"""Seconds until Ray declares a node dead that no longer answers: five health checks, with some time to spare."""


def train(
    config: LeagueConfig,
    *,
    registry: Registry,
    parent: CheckpointRef | None = None,
    role: Role = MAIN,
    target: CheckpointRef | None = None,
    resume: bool = False,
    name: str | None = None,
    address: str | None = None,
    local: LocalRay = UNLIMITED,
    config_path: Path | None = None,
    console: Console | None = None,
    measure: Measure | None = None,
) -> list[VersionRow]:
    """Train `config` until its budget (`training.steps`, `training.minutes`) is spent.

    Registers the league unless the run has a `name`, runs one Ray Tune trial, shows its progress, records it in the
    registry, writes TensorBoard files to `<home>/runs/<league>/<run>`, and publishes a version at each checkpoint.

    If a node of the cluster is lost, the run continues on the others from its newest version. If one is drained, or
    nodes join that make it faster, its state is published and it continues from there.

    The first SIGINT or SIGTERM saves and publishes the current state, and raises Interrupted. A second one raises
    KeyboardInterrupt immediately. The run can be resumed in both cases.

    Args:
        config: The league.
        registry: Where versions are published.
        parent: The version to continue from; the first version of the run records it as its parent.
        role: The role of the versions.
        target: The version that an exploiter is trained against, in all episodes and instead of `training.opponents`.
            An alias is resolved at the start.
        resume: Continue the league's newest run of this role, which was interrupted or has a larger budget now. It may
            have begun on another machine that uses the same registry. Its versions stay, and checkpoints that were
            saved on this machine but not published are published first. With a checkpoint interval in steps and one
            runner, the versions equal those of an uninterrupted run.
        name: The id of the run, by default a new one. A run with this id continues with the settings that it began
            with; if it is complete, nothing is trained. Its league must be registered.
        address: A running Ray cluster. None uses the Ray that this process is connected to, or starts one.
        local: Limits of a Ray that is started; it ends with the run.
        config_path: The file of `config`; its git commit is recorded in the manifests.
        console: Where progress is shown: a bar in a terminal, plain lines elsewhere.
        measure: Measures the strength of each version (`training.strength`).

    Returns:
        All versions of this run, ascending, including those from before an interruption.

    Raises:
        LeagueError: A new exploiter without a target, or a target without this role; nothing to resume, or changed
            settings; an unknown or incompatible parent; missing or incompatible opponents; a run that another process
            works on; a cluster whose machines do not share storage; a fault of the environment; an export that fails
            its parity check (earlier versions stay).
    """
    _check_options(parent, role, target, resume)
    silence_tune()
    interface = interface_of(config)
    check(config, interface)
    check_contestants(config, interface, registry)
    if name is None:
        # A run with an id has other settings than its league: the seed of a night, the budget of an exploiter.
        registry.leagues.register(config, interface)
    exploits = None if target is None else _target(registry, target, config, interface)
    if exploits is not None:
        config = config.against(exploits)
        check(config, interface)
    start = None if parent is None else parent_version(registry, parent, config, interface)
    earlier = None
    if resume:
        earlier = RunDirectory.resume(registry, config, role)
    elif name is not None:
        earlier = RunDirectory.find(registry, config, name)
    if earlier is not None and earlier.record.complete:
        # Its driver may have died between the end of training and its last report.
        with suppress(UnknownRun):
            registry.runs.end(config.league, earlier.id, "ended")
        return published_versions(registry, earlier)
    pins = {} if earlier else pin_opponents(config, registry, interface)
    with connected(address, registry.storage, local) as dashboard:
        run = earlier or RunDirectory.begin(
            registry.storage,
            config,
            None if start is None else start.number,
            git_commit(config_path),
            pins,
            exploits,
            name,
            0 if start is None else start.steps,
        )
        progress = TrainingProgress(console or Console(), run.record.config.training, interface.policies)
        strength = StrengthQueue(run, registry, progress, measure)
        with run.locked(), progress, strength:
            with RunReporter(registry, run) as reporter:
                _describe(config, interface, run, dashboard, progress)
                RunDriver(run, registry, interface, progress, reporter, strength).train()
            strength.join()
    return published_versions(registry, run)


def _check_options(parent: CheckpointRef | None, role: Role, target: CheckpointRef | None, resume: bool) -> None:
    """Raise ConfigError for options that exclude each other."""
    if resume and parent is not None:
        raise ConfigError("a resumed run already has its parent: use either --from or --resume")
    if (target is not None) != (role == EXPLOITER and not resume):
        raise ConfigError(
            "--role exploiter and --against belong together, except in a resumed run, which keeps its target"
        )


def _describe(
    config: LeagueConfig, interface: Interface, run: RunDirectory, dashboard: str | None, progress: TrainingProgress
) -> None:
    progress.say(f"{config.environment.entry_point}: {implementation(config.environment).reason}")
    count, runners = num_envs(config, len(interface.agents)), config.training.runners
    where = f"each of {runners} runners" if runners > 1 else "one runner" if runners else "the learner's process"
    progress.say(f"Environments: {count} in {where}.")
    if run.record.exploits is not None:
        progress.say(f"Role: {run.record.role}. Opponent in all episodes: {run.record.exploits}.")
    progress.say(describe_policies(interface))
    progress.say(describe_selection(config, interface))
    if dashboard:
        progress.say(f"Ray's dashboard: {dashboard}")


def check(config: LeagueConfig, interface: Interface) -> None:
    """Raise ConfigError for invalid settings before anything is started."""
    algorithm_config(config, interface)
    module_spec(config.training, interface).build()


def _target(registry: Registry, ref: CheckpointRef, config: LeagueConfig, interface: Interface) -> str:
    """Return the version that an exploiter is trained against, which must be able to play in the league now."""
    if len(interface.sides) < 2:
        raise ConfigError(f"--against: league {config.league} has one side only, so a version has no opponent")
    if not config.training.supports_opponents:
        raise ConfigError(f"--against: {config.training.algorithm} does not support opponents")
    check_eligible(str(ref), registry, config)
    return registry.versions.resolve(ref).ref


class RunDriver:
    """Trains one run and publishes its checkpoints. Training continues in a new attempt when nodes come and go."""

    def __init__(
        self,
        run: RunDirectory,
        registry: Registry,
        interface: Interface,
        progress: TrainingProgress,
        reporter: RunReporter,
        strength: StrengthQueue,
    ) -> None:
        """Start the thread that publishes."""
        self._run, self._registry, self._interface = run, registry, interface
        self._progress, self._reporter, self._strength = progress, reporter, strength
        self._publisher = PublishQueue(run, registry, interface, self._announce)

    def train(self) -> None:
        """Train until the budget is spent. Raises Interrupted, once all is published, if a stop is requested before."""
        try:
            self._publish_remaining()
            spent = self._attempts()
        except Exception:
            self._publisher.join()
            raise
        self._publisher.join()
        if not spent:
            versions = published_versions(self._registry, self._run)
            published = ", ".join(version.ref for version in versions) or "nothing yet"
            has_own_id = OWN_ID.fullmatch(self._run.id)
            how = "To continue: --resume." if has_own_id else "To continue, run the same command again."
            raise Interrupted(f"Ended early. Published: {published}. TensorBoard: {self._run.path}. {how}")
        self._run.complete()

    def _announce(self, version: VersionRow) -> None:
        self._progress.published(version)
        self._strength.add(version)

    def _publish_remaining(self) -> None:
        """Publish the checkpoints of earlier attempts, then delete them."""
        self._publisher.join()  # those that are in its queue are removed when they are published
        for checkpoint in self._run.checkpoints():
            self._publisher.add(checkpoint)
        self._publisher.join()
        self._run.remove_checkpoints()

    def _attempts(self) -> bool:
        """Train until the budget is spent or a stop is requested; returns which."""
        while True:
            nodes = node_ids()
            try:
                end = self._tune()
                if end != "moved":
                    return end == "spent"
            except LeagueError as error:
                lost = lost_nodes(nodes, NODE_LOSS_TIMEOUT if is_process_lost(error) and len(nodes) > 1 else 0)
                if not lost:
                    raise
                self._progress.say(
                    f"{len(lost)} of {len(nodes)} nodes were lost ({one_line(error)}). Training continues."
                )
            self._publish_remaining()

    def _tune(self) -> Literal["spent", "stopped", "moved"]:
        """Run one attempt as a Tune experiment of one trial. Returns why it ended; `moved`: to continue on other
        nodes."""
        run, progress, publisher = self._run, self._progress, self._publisher
        config, attempt = run.record.config, run.next_attempt()
        share = cpu_share(config.training.runners)
        plan = self._plan(attempt, share)
        self._reporter.begin(plan.start.steps - plan.start.steps_before_run, plan.start.seconds)

        is_stop_requested = False

        def request_stop() -> None:
            nonlocal is_stop_requested
            is_stop_requested = True
            plan.stop_file.touch()
            progress.say("Ending after this update, then publishing. Press Ctrl-C again to end immediately.")

        watch = NodeWatch(config.training, share, progress.say, plan.stop_file.touch)
        callbacks = [_ResultCallback(publisher, progress, self._reporter), watch]
        tuner = tune.Tuner(
            tune.with_resources(Trial, placement(config.training, share)),
            param_space={
                "league": config.model_dump(mode="json", by_alias=True),
                "interface": self._interface.model_dump(mode="json"),
                "plan": plan,
            },
            tune_config=tune.TuneConfig(trial_dirname_creator=lambda _: attempt.name),
            run_config=run_config(run.path, callbacks, _StopOnPublishError(publisher)),
        )
        try:
            result = fit(tuner, request_stop)[0]
        finally:
            shutil.rmtree(attempt / CHECKPOINTS / START, ignore_errors=True)
        if result.error is not None:
            raise training_error(result.error, config.league, attempt / "error.txt") from result.error
        if (result.metrics or {}).get("spent"):
            return "spent"
        if watch.reason is None or is_stop_requested or publisher.error is not None:
            return "stopped"
        progress.say(f"{watch.reason[0].upper()}{watch.reason[1:]}. Training continues.")
        return "moved"

    def _plan(self, attempt: Path, share: float) -> TrialPlan:
        """Prepare an attempt in its directory. share: CPUs of each of its processes."""
        config = self._run.record.config
        (attempt / CHECKPOINTS).mkdir(parents=True)
        check_nodes(self._registry.storage)  # some may have joined meanwhile
        if (cpus := share * (1 + config.training.runners)) > (available := cluster_cpus()):
            self._progress.say(f"Ray's autoscaler is asked for {cpus:g} CPUs; the cluster has {available}.")
        start = self._start(attempt / CHECKPOINTS / START)
        if start.checkpoint is not None and starts_with_empty_replay(config.training, start.checkpoint):
            self._progress.say(
                "The replay buffer starts empty: learning begins after training.learning_starts transitions."
            )
        return TrialPlan(
            start,
            attempt / CHECKPOINTS,
            attempt / STOP_FILE,
            self._registry.storage,
            cpus=share,
            run=self._run.id,
            parent=self._run.record.parent,
            driver=driver_machine(),
        )

    def _start(self, private: Path) -> StartState:
        """Return the state to train from: the run's newest version, otherwise its parent, otherwise none.

        RLlib unpickles it. Therefore it is verified in a private copy, which nobody else can change in between.
        """
        record, versions = self._run.record, self._registry.versions
        league, before = record.config.league, record.parent_steps
        if published := published_versions(self._registry, self._run):
            state = versions.copy(league, published[-1].number, TRAINING, private)
            steps, seconds = read_progress(state)
            return StartState(state, steps, before, seconds)
        if record.parent is not None:
            return StartState(versions.copy(league, record.parent, TRAINING, private), before, before, 0.0)
        return FROM_SCRATCH


class _ResultCallback(NotPickled, tune.Callback):
    """Receives each result of the trial in the driver's process."""

    def __init__(self, publisher: PublishQueue, progress: TrainingProgress, reporter: RunReporter) -> None:
        self._publisher = publisher
        self._progress = progress
        self._reporter = reporter

    def on_trial_result(self, *, result: dict[str, Any], **_: Any) -> None:
        self._progress.update(result)
        self._reporter.report(result)
        if "checkpoint" in result:
            self._publisher.add(Path(result["checkpoint"]))


class _StopOnPublishError(NotPickled, tune.Stopper):
    """Ends training when a version cannot be published."""

    def __init__(self, publisher: PublishQueue) -> None:
        self._publisher = publisher

    def __call__(self, *_: Any) -> bool:
        return self.stop_all()

    def stop_all(self) -> bool:
        return self._publisher.error is not None
