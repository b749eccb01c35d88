"""Reports a run to experiment trackers (`training.trackers`): curves, settings, strength, and versions as artefacts.

Each tracker has a thread: a slow one delays nothing, and the errors of one that is down never end a run.

Ray's logger callbacks are not used, because they are called in Tune's event loop, where an exception ends the
experiment; begin another run of the tracker whenever a run is resumed; and receive neither versions nor their strength.
"""

import hashlib
import importlib
import logging
import os
import queue
import re
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from league.config.training import TrackerName
from league.entry_points import import_entry_point
from league.errors import ConfigError, no_exit, one_line
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_files
from league.registry.storage.rows import RunState, StrengthRow, VersionRow
from training.runs.run_directory import RunDirectory
from training.runs.run_reporter import ending, is_metric, tag
from training.runs.strength_queue import STRENGTH, Measure

KEY = "training.trackers"
PACKAGES: Mapping[str, str] = {"wandb": "wandb", "mlflow": "mlflow", "comet": "comet_ml", "aim": "aim"}
"""Tracker → its module."""
WAITING = 1000
"""Maximum number of reports that wait for a tracker. Further ones are dropped."""
MLFLOW_BATCH, MLFLOW_LENGTH = 100, 6000
"""Limits of MLflow: parameters of a request, and characters of a value."""
LAST_SECONDS = 60.0
"""How long an ending driver waits for each tracker, in seconds."""


def check_trackers(names: tuple[TrackerName, ...]) -> None:
    """Raise ConfigError if the package of a tracker is missing, or a class of the user's code is no Tracker."""
    for name in names:
        if name not in PACKAGES:
            imported = import_entry_point(KEY, name)
            if not all(callable(getattr(imported, method, None)) for method in ("log", "add", "end")):
                raise ConfigError(f"{KEY}: {name}: expected a class with the methods log, add and end")
        elif find_spec(PACKAGES[name]) is None:
            raise ConfigError(f"{KEY}: {name} requires a package: pip install 'policy-league[{name}]'")


class Tracker(Protocol):
    """A run in an experiment tracker, created from a RunDirectory. All methods may raise any exception."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Add points to curves. step: actions of all agents, including parents'."""

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        """Add a version as an artefact. files: its graphs and manifest."""

    def end(self, state: RunState) -> None:
        """Send what remains."""


class Trackers:
    """A context manager around a driver's work. How the block ends is reported as how the run ended."""

    def __init__(self, run: RunDirectory, registry: Registry, say: Callable[[str], None]) -> None:
        """say: shows a message, once for each tracker that cannot be reached."""
        self._run, self._registry = run, registry
        self._queues = [_Queue(name, run, say) for name in run.record.config.training.trackers]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for reports in self._queues:
            reports.close(ending(error)[0])
        for reports in self._queues:
            reports.join()

    def report(self, result: Mapping[str, Any]) -> None:
        """Report a trial's latest metrics, with the names that they have in TensorBoard."""
        curves = {tag(name): value for name, value in result.items() if is_metric(name, value)}
        self._put(curves, int(result["timesteps_total"]))

    def published(self, version: VersionRow) -> None:
        """Report a version: its policies and its manifest, without the state of training."""
        run = self._run
        about = {"league": version.league, "version": version.ref, "run": run.id, "steps": version.steps}

        def add(tracker: Tracker) -> None:
            with tempfile.TemporaryDirectory(prefix="league-tracker-") as directory:
                files = Path(directory) / "files"
                write_files(exported_files(version, self._registry.artifacts), files)
                tracker.add(version.ref, files, about)

        for reports in self._queues:
            reports.put(add)

    def measuring(self, measure: Measure | None) -> Measure | None:
        """Return `measure`, which also reports the scores."""
        if measure is None or not self._queues:
            return measure

        def measured(version: VersionRow, games: int) -> list[StrengthRow]:
            rows = measure(version, games=games)
            for row in rows:
                scores = {"score": row.score, "low": row.low, "high": row.high}
                self._put({f"{STRENGTH}/{row.opponent}/{name}": score for name, score in scores.items()}, row.steps)
            return rows

        return measured

    def _put(self, values: Mapping[str, float], step: int) -> None:
        for reports in self._queues:
            reports.put(lambda tracker: tracker.log(values, step))


class _Queue:
    """The reports that wait for a tracker, and the thread that sends them."""

    def __init__(self, name: TrackerName, run: RunDirectory, say: Callable[[str], None]) -> None:
        self._name, self._run, self._say = name, run, say
        self._reports: queue.Queue[Callable[[Tracker], None] | None] = queue.Queue()
        self._has_failed = False
        self._thread = threading.Thread(target=self._send, name=f"tracker-{name}", daemon=True)
        self._thread.start()

    def put(self, report: Callable[[Tracker], None]) -> None:
        """Send a report after those before it, or none if too many wait."""
        if self._reports.qsize() < WAITING:
            self._reports.put(report)

    def close(self, state: RunState) -> None:
        """Report how the run ended, after all other reports."""
        self._reports.put(lambda tracker: tracker.end(state))
        self._reports.put(None)

    def join(self) -> None:
        """Wait until all is sent, but not for a tracker that does not answer."""
        self._thread.join(LAST_SECONDS)
        if self._thread.is_alive():
            self._failed(f"no answer within {LAST_SECONDS:g} s")

    def _send(self) -> None:
        tracker: Tracker | None = None
        while (report := self._reports.get()) is not None:
            try:
                with no_exit:
                    if tracker is None:
                        tracker = (OPEN.get(self._name) or import_entry_point(KEY, self._name))(self._run)
                    assert tracker is not None
                    report(tracker)
            except Exception as error:  # a report must never end a run
                self._failed(one_line(error, with_type=True))

    def _failed(self, reason: str) -> None:
        if not self._has_failed:
            self._say(f"Cannot report to {self._name}; training continues: {reason}")
        self._has_failed = True


def _settings(run: RunDirectory) -> dict[str, Any]:
    """Return the configuration of a run and where it is found: in the league, and on its pages if LEAGUE_URL is set."""
    record = run.record
    server = os.environ.get("LEAGUE_URL")
    link = {"url": f"{server.rstrip('/')}/leagues/{record.config.league}/runs/{run.id}"} if server else {}
    identity = {"league": record.config.league, "run": run.id, "git_commit": record.git_commit, **link}
    return identity | record.config.model_dump(mode="json", by_alias=True, include={"environment", "training"})


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dots: `training.lr`."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) and value else {f"{prefix}{name}": value}
    return flat


def _tracker_id(run: RunDirectory, name: str, create: Callable[[], str]) -> str:
    """Return the tracker's id of a run, which a resumed run continues with."""
    file = run.path / f"{name}.id"
    if not file.exists():
        file.write_text(create())
    return file.read_text()


class Wandb:
    """A run of Weights & Biases."""

    def __init__(self, run: RunDirectory) -> None:
        import wandb

        league = run.record.config.league
        self._artifact = wandb.Artifact
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", league),
            id=run.id,
            name=run.id,
            resume="allow",
            dir=run.path,
            config=_settings(run),
            allow_val_change=True,
            settings=wandb.Settings(console="off", silent=True),
        )
        # Strength is known later than the curves of the same step, which W&B would ignore.
        self._run.define_metric("*", step_metric="steps")

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._run.log({**values, "steps": step})

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        league, _, number = ref.partition("@")
        artifact = self._artifact(league, type="model", description=ref, metadata=dict(about))
        artifact.add_dir(str(files))
        self._run.log_artifact(artifact, aliases=[f"version-{number}"])

    def end(self, state: RunState) -> None:
        self._run.finish(exit_code=int(state == "failed"))


class Mlflow:
    """A run of MLflow, in the experiment `MLFLOW_EXPERIMENT_NAME` or that of its league."""

    STATES: Mapping[RunState, str] = {"ended": "FINISHED", "failed": "FAILED", "stopped": "KILLED"}

    def __init__(self, run: RunDirectory) -> None:
        entities = importlib.import_module("mlflow.entities")
        self._client, self._metric = importlib.import_module("mlflow").MlflowClient(), entities.Metric
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", run.record.config.league)

        def create() -> str:
            experiment = self._client.get_experiment_by_name(name)
            number = self._client.create_experiment(name) if experiment is None else experiment.experiment_id
            created = self._client.create_run(number, run_name=run.id).info.run_id
            settings = [(_allowed(key), str(value)[:MLFLOW_LENGTH]) for key, value in _flat(_settings(run)).items()]
            for start in range(0, len(settings), MLFLOW_BATCH):
                params = [entities.Param(*setting) for setting in settings[start : start + MLFLOW_BATCH]]
                self._client.log_batch(created, params=params)
            return str(created)

        self._id = _tracker_id(run, "mlflow", create)  # parameters are logged once, since they cannot change
        self._client.update_run(self._id, status="RUNNING")

    def log(self, values: Mapping[str, float], step: int) -> None:
        milliseconds = int(1000 * time.time())
        points = [self._metric(_allowed(name), value, milliseconds, step) for name, value in values.items()]
        self._client.log_batch(self._id, metrics=points)

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        self._client.log_artifacts(self._id, str(files), _allowed(ref))
        self._client.log_dict(self._id, dict(about), f"{_allowed(ref)}/version.json")

    def end(self, state: RunState) -> None:
        self._client.set_terminated(self._id, self.STATES[state])


def _allowed(name: str) -> str:
    """Return a name with the characters that MLflow allows: `opponents/connect_four-3/score`."""
    return re.sub(r"[^\w/. -]", "-", name)


class Comet:
    """An experiment of Comet, in the project `COMET_PROJECT_NAME` or that of its league."""

    def __init__(self, run: RunDirectory) -> None:
        comet_ml = importlib.import_module("comet_ml")
        logging.getLogger("comet_ml").setLevel(logging.ERROR)
        # By default, Comet also takes source code, the terminal's output, and what it finds in other libraries.
        contents = ("code", "git_metadata", "git_patch", "env_details", "graph")
        self._experiment = comet_ml.start(
            project_name=os.environ.get("COMET_PROJECT_NAME", run.record.config.league),
            experiment_key=hashlib.sha256(run.id.encode()).hexdigest()[:32],
            mode="get_or_create",
            experiment_config=comet_ml.ExperimentConfig(
                **{f"log_{item}": False for item in contents},
                auto_param_logging=False,
                auto_metric_logging=False,
                auto_output_logging=False,
                display_summary_level=0,
            ),
        )
        self._experiment.set_name(run.id)
        self._experiment.log_parameters(_flat(_settings(run)))

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._experiment.log_metrics(dict(values), step=step)

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        self._experiment.log_model(ref, str(files), metadata=dict(about))

    def end(self, _: RunState) -> None:
        self._experiment.end()


class Aim:
    """A run of Aim. Versions are links to the league: Aim stores no files without a store of its own."""

    def __init__(self, run: RunDirectory) -> None:
        aim = importlib.import_module("aim")
        settings = {"system_tracking_interval": None, "capture_terminal_logs": False}

        def create() -> str:
            created = aim.Run(experiment=run.record.config.league, **settings)
            created.close()
            return str(created.hash)

        self._run = aim.Run(_tracker_id(run, "aim", create), **settings)
        self._run.name = run.id
        self._run["settings"] = _settings(run)
        self._versions: dict[str, Any] = {}

    def log(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            group, _, curve = name.partition("/")
            self._run.track(value, name=curve, step=step, context={"group": group})

    def add(self, ref: str, _: Path, about: Mapping[str, Any]) -> None:
        self._versions[ref] = dict(about)
        self._run["versions"] = self._versions

    def end(self, _: RunState) -> None:
        self._run.close()


OPEN: dict[str, Callable[[RunDirectory], Tracker]] = {
    "wandb": Wandb,
    "mlflow": Mlflow,
    "comet": Comet,
    "aim": Aim,
}
"""Tracker → how a run in it is opened, or opened again."""
