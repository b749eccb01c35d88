"""Training as a Ray job: the same command, run on the head of a cluster, while its output is followed from here."""

import asyncio
import logging
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ray.exceptions import AuthenticationError
from ray.job_submission import JobStatus, JobSubmissionClient

from league.errors import ConfigError, LeagueError
from league.settings import Storage

STARTS_WITHIN = 60.0
"""Seconds."""
NOT_YET = "No available agent"
"""Ray's words for a cluster that takes no jobs yet."""
CHATTY = ("ray.dashboard.modules.job.sdk", "ray.dashboard.modules.dashboard_sdk", "ray._private.runtime_env.packaging")
LOOPBACK = {"127.0.0.1", "localhost", "::1"}


def submit(address: str, config: Path, arguments: Sequence[str], storage: Storage, say: Callable[[str], None]) -> None:
    """Run `league train <config> <arguments>` as a job and say what it says, until it is over.

    The job gets the league's file and where `storage` is, nothing else: an environment of one's own must be installed
    on the cluster, as this package must. address: of the cluster's dashboard, `http://HOST:8265`.

    Raises ConfigError: no such cluster, or storage that it does not reach. LeagueError: the job failed.
    KeyboardInterrupt stops following, and the job goes on.
    """
    host = urlsplit(address).hostname
    if not address.startswith(("http://", "https://")) or host is None:
        raise ConfigError(f"--job: expected --address http://HOST:8265, the cluster's dashboard, got {address!r}")
    if host not in LOOPBACK:
        _check_reach(host, storage)
    for chatty in CHATTY:
        logging.getLogger(chatty).setLevel(logging.ERROR)
    client = _client(address)
    with tempfile.TemporaryDirectory() as directory:
        shutil.copy(config, directory)
        command = shlex.join(["league", "train", config.name, "--address", "auto", *arguments])
        job = _begin(client, command, {"working_dir": directory, "env_vars": _environment(storage)})
    say(f"Job {job} is submitted. To stop it: ray job stop {job} --address {address}")
    try:
        asyncio.run(_follow(client, job, say))
    except KeyboardInterrupt:
        say(f"\nThe job goes on. To follow it: ray job logs {job} --follow --address {address}")
        say(f"To stop it: ray job stop {job} --address {address}")
        raise
    _check_end(client, job)


def _client(address: str) -> JobSubmissionClient:
    try:
        return JobSubmissionClient(address)
    except AuthenticationError as error:
        raise ConfigError(f"--job: {address} wants a token: set RAY_AUTH_TOKEN, or RAY_AUTH_TOKEN_PATH") from error
    except (ConnectionError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"--job: no Ray dashboard at {address}: {reason}") from error


def _begin(client: JobSubmissionClient, command: str, runtime_env: dict[str, Any]) -> str:
    """Submit the job. A cluster that has just started takes a while until it takes jobs."""
    deadline = time.monotonic() + STARTS_WITHIN
    while True:
        try:
            return str(client.submit_job(entrypoint=command, runtime_env=runtime_env))
        except RuntimeError as error:
            if NOT_YET not in str(error) or time.monotonic() > deadline:
                raise LeagueError(f"the cluster did not take the job: {' '.join(str(error).split())}") from error
            time.sleep(0.5)


async def _follow(client: JobSubmissionClient, job: str, say: Callable[[str], None]) -> None:
    async for lines in client.tail_job_logs(job):
        say(lines.rstrip("\n"))


def _check_end(client: JobSubmissionClient, job: str) -> None:
    info = client.get_job_info(job)
    if info.status is not JobStatus.SUCCEEDED:
        raise LeagueError(f"job {job}: {info.status.value.lower()}: {' '.join((info.message or '').split())}")


def _environment(storage: Storage) -> dict[str, str]:
    """The job writes to where this process would, and finds `league` where it is here if it is not on its path."""
    return {
        "LEAGUE_HOME": str(storage.home),
        "LEAGUE_DATABASE_URL": storage.database_url,
        "LEAGUE_ARTIFACTS": str(storage.artifacts),
        "PATH": f"${{PATH}}:{Path(sys.executable).parent}",
    }


def _check_reach(host: str, storage: Storage) -> None:
    try:
        storage.check_reach({"here", host})
    except ConfigError as error:
        raise ConfigError(
            f"--job: {host} is another machine: set LEAGUE_DATABASE_URL to a PostgreSQL server, LEAGUE_ARTIFACTS to a"
            " directory that both mount, and LEAGUE_HOME to one on the cluster's head"
        ) from error
