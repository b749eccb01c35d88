"""Runs one training run: Ray Tune trains, and the driver publishes each checkpoint as a version."""

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from ray import tune
from rich.console import Console

from league.conditions import describe_selection
from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import describe_policies
from league.environments.building import interface as interface_of
from league.environments.implementation import implementation
from league.errors import ConfigError, LeagueError, UnknownRun, one_line
from league.interface import Interface
from league.local_ray.loopback_node import is_own
from league.policies.loading import check_contestants, check_eligible
from league.ray_cluster import (
    UNLIMITED,
    LocalRay,
    check_nodes,
    cluster_cpus,
    connected,
    lost_nodes,
    node_addresses,
    node_ids,
    node_resources,
)
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MAIN, TRAINING, Role
from league.registry.storage.rows import VersionRow
from training.algorithms.metrics import RETURN, metric_names
from training.algorithms.off_policy import starts_with_empty_replay
from training.algorithms.resources import Resources, describe, resources
from training.algorithms.rllib_config import algorithm_class, algorithm_config, module_spec, with_algorithm
from training.export.network_check import check_network
from training.export.publish import git_commit
from training.rllib_compat import NotPickled, silence_tune, use_waiting_workers
from training.runs.callbacks import Callbacks, callback_class
from training.runs.driver_files import driver_machine
from training.runs.error_messages import is_process_lost, training_error
from training.runs.node_watch import NodeWatch
from training.runs.parent import parent_version
from training.runs.progress import TrainingProgress
from training.runs.publish_queue import PublishQueue, published_versions
from training.runs.run_directory import CHECKPOINTS, OWN_ID, START, STOP_FILE, RunDirectory, pin_opponents
from training.runs.run_reporter import RunReporter
from training.runs.simulator_watch import SimulatorWatch
from training.runs.strength_queue import Measure, StrengthQueue
from training.runs.trackers import Trackers, check_trackers
from training.runs.trial import EPISODES, FROM_SCRATCH, UPDATES, StartState, Trial, TrialPlan, read_progress
from training.runs.tune import Interrupted, cpu_share, fit, placement, run_config
from training.sampling.self_play import OPPONENTS, SCORE

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

    If a node of the cluster is lost, the run continues on the others from its newest version; likewise if a learner or
    a runner is lost, provided that it has published a version since it began or was last continued. If a node is
    drained, or nodes join that make it faster, its state is published and it continues from there.

    The first SIGINT, SIGTERM or SIGHUP saves and publishes the current state, and raises Interrupted. A second one
    raises KeyboardInterrupt immediately. The run can be resumed in both cases.

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
    config, interface = with_algorithm(config), interface_of(config)
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
        if is_own():
            use_waiting_workers()
        settings, nodes = config if earlier is None else earlier.record.config, node_resources()
        used = resources(settings, len(interface.agents), nodes)
        placement(used, cpu_share(used.processes))  # raises before the run begins
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
        run.use(used)
        progress = TrainingProgress(console or Console(), run.record.config.training, interface.policies)
        callbacks = Callbacks(run.record.config.training.callbacks, interface)
        with (
            run.locked(),
            progress,
            Trackers(run, registry, progress.say) as trackers,
            StrengthQueue(run, registry, progress, trackers.measuring(measure)) as strength,
        ):
            with RunReporter(registry, run) as reporter:
                _describe(config, interface, run, describe(settings, len(interface.agents), nodes), dashboard, progress)
                RunDriver(run, registry, interface, progress, reporter, strength, callbacks, trackers).train()
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
    config: LeagueConfig,
    interface: Interface,
    run: RunDirectory,
    choice: str,
    dashboard: str | None,
    progress: TrainingProgress,
) -> None:
    progress.say(f"{config.environment.entry_point}: {implementation(config.training_environment).reason}")
    progress.say(choice)
    if run.record.exploits is not None:
        progress.say(f"Role: {run.record.role}. Opponent in all episodes: {run.record.exploits}.")
    for entry_point, digest in run.record.code.items():
        progress.say(f"Code: {entry_point}, SHA-256 {digest}.")
    progress.say(describe_policies(interface))
    progress.say(describe_selection(config, interface))
    if dashboard:
        progress.say(f"Ray's dashboard: {dashboard}")


def check(config: LeagueConfig, interface: Interface) -> None:
    """Raise ConfigError for invalid settings before anything is started."""
    check_trackers(config.training.trackers)
    _check_environments(config, interface)
    algorithm_config(config, interface)
    module_spec(config.training, interface).build()
    check_network(config, interface)
    for entry_point in config.training.callbacks:
        callback_class(entry_point)


def _check_environments(config: LeagueConfig, interface: Interface) -> None:
    """Raise ConfigError if the wrappers of training or the arguments of a stage cannot be applied, or change spaces."""
    if config.training.wrappers:
        _check_environment(
            config,
            interface,
            config.training_environment,
            "training.wrappers",
            "a wrapper that changes spaces belongs into environment.wrappers",
        )
    for number, stage in enumerate(config.training.curriculum, 1):
        for kwargs in stage.extremes():
            _check_environment(
                config,
                interface,
                config.training_environment.with_arguments(kwargs),
                f"training.curriculum: stage {number}",
                "all stages must have the spaces of the game",
            )

    curves = metric_names(interface, algorithm_class(config.training.algorithm).curves)
    for number, stage in enumerate(config.training.curriculum, 1):
        for curve in stage.until:
            if curve not in curves and not curve.startswith(f"{OPPONENTS}/"):
                raise ConfigError(
                    f"training.curriculum: stage {number}: until: unknown curve {curve!r}, expected for example"
                    f" {RETURN}, {interface.policy_ids[0]}/{RETURN} or {OPPONENTS}/script:random/{SCORE}"
                )


def _check_environment(
    config: LeagueConfig, interface: Interface, environment: EnvironmentConfig, place: str, rule: str
) -> None:
    try:
        in_training = interface_of(config.model_copy(update={"environment": environment}))
    except ConfigError as error:  # the environment of matches has been built
        message = str(error).removeprefix("environment.wrappers: ").removeprefix("environment.kwargs: ")
        raise ConfigError(f"{place}: {message}") from error
    for agent in interface.agents | in_training.agents:
        for kind in ("observation", "action"):
            in_matches, changed = (getattr(one.agents.get(agent), kind, None) for one in (interface, in_training))
            if changed != in_matches:
                raise ConfigError(
                    f"{place}: {agent} has {kind}s in {changed} in training, but in {in_matches} in matches: {rule}"
                )


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
        callbacks: Callbacks,
        trackers: Trackers,
    ) -> None:
        """Start the thread that publishes."""
        self._callbacks = callbacks
        self._run, self._registry, self._interface = run, registry, interface
        self._progress, self._reporter = progress, reporter
        self._strength, self._trackers = strength, trackers
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
        self._progress.advise(self._resources, cluster_cpus())
        versions = published_versions(self._registry, self._run)
        self._callbacks.end(versions)
        if not spent:
            published = ", ".join(version.ref for version in versions) or "nothing yet"
            has_own_id = OWN_ID.fullmatch(self._run.id)
            how = "To continue: --resume." if has_own_id else "To continue, run the same command again."
            raise Interrupted(f"Ended early. Published: {published}. TensorBoard: {self._run.path}. {how}")
        self._run.complete()

    @property
    def _resources(self) -> Resources:
        return resources(self._run.record.config, len(self._interface.agents))

    def _announce(self, version: VersionRow) -> None:
        self._progress.published(version)
        self._trackers.published(version)
        self._strength.add(version)
        self._callbacks.add(version)

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
            nodes, published = node_ids(), len(published_versions(self._registry, self._run))
            try:
                end = self._tune()
                if end != "moved":
                    return end == "spent"
            except LeagueError as error:
                lost = lost_nodes(nodes, NODE_LOSS_TIMEOUT if is_process_lost(error) and len(nodes) > 1 else 0)
                what = f"{len(lost)} of {len(nodes)} nodes were lost" if lost else "A process was lost"
                self._publish_remaining()
                # Without a new version, the next attempt would probably end like this one.
                is_advancing = len(published_versions(self._registry, self._run)) > published
                if not lost and not (is_process_lost(error) and is_advancing):
                    raise
                self._progress.say(f"{what} ({one_line(error)}). Training continues.")
            else:
                self._publish_remaining()

    def _tune(self) -> Literal["spent", "stopped", "moved"]:
        """Run one attempt as a Tune experiment of one trial. Returns why it ended; `moved`: to continue on other
        nodes."""
        run, progress, publisher = self._run, self._progress, self._publisher
        config, attempt = run.record.config, run.next_attempt()
        used = self._resources
        share = cpu_share(used.processes)
        plan = self._plan(attempt, share, used.processes)
        self._reporter.begin(plan.start.steps - plan.start.steps_before_run, plan.start.seconds)

        is_stop_requested = False

        def request_stop() -> None:
            nonlocal is_stop_requested
            is_stop_requested = True
            plan.stop_file.touch()
            progress.say("Ending after this update, then publishing. Press Ctrl-C again to end immediately.")

        watch = NodeWatch(used, share, progress.say, plan.stop_file.touch)
        self._callbacks.request_stop = plan.stop_file.touch
        receiver = _ResultCallback(publisher, progress, self._reporter, self._callbacks, self._trackers)
        callbacks: list[tune.Callback] = [receiver, watch]
        if config.environment.external is not None:
            callbacks.append(SimulatorWatch(self._registry, config.league, progress.say, len(node_addresses())))
        tuner = tune.Tuner(
            tune.with_resources(Trial, placement(used, share)),
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
        failed = publisher.error is not None or self._callbacks.error is not None
        if watch.reason is None or is_stop_requested or failed:
            return "stopped"
        progress.say(f"{watch.reason[0].upper()}{watch.reason[1:]}. Training continues.")
        return "moved"

    def _plan(self, attempt: Path, share: float, processes: int) -> TrialPlan:
        """Prepare an attempt in its directory. share: CPUs of each of its processes."""
        config = self._run.record.config
        (attempt / CHECKPOINTS).mkdir(parents=True)
        check_nodes(self._registry.storage)  # some may have joined meanwhile
        if (cpus := share * processes) > (available := cluster_cpus()):
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

    def __init__(
        self,
        publisher: PublishQueue,
        progress: TrainingProgress,
        reporter: RunReporter,
        callbacks: Callbacks,
        trackers: Trackers,
    ) -> None:
        self._callbacks = callbacks
        self._publisher = publisher
        self._trackers = trackers
        self._progress = progress
        self._reporter = reporter

    def on_trial_result(self, *, result: dict[str, Any], **_: Any) -> None:
        result |= self._callbacks.report(result.pop(EPISODES, ()), result.pop(UPDATES, ()))
        self._progress.update(result)
        self._reporter.report(result)
        self._trackers.report(result)
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
