"""Submits a training run as a Ray job to a cluster, and prints the job's output."""

import asyncio
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

from league.errors import ConfigError, LeagueError, one_line
from league.settings import Storage
from training.rllib_compat import NO_JOB_AGENT, silence_job_submission

STARTS_WITHIN = 60.0
"""Seconds that a new cluster has to accept the job."""
LOOPBACK = {"127.0.0.1", "localhost", "::1"}


def submit(address: str, config: Path, arguments: Sequence[str], storage: Storage, say: Callable[[str], None]) -> None:
    """Run `league train <config> <arguments>` as a job, and print its output until it ends.

    The job receives the league's file and the location of `storage` only: custom environments must be installed on the
    cluster, as must this package. KeyboardInterrupt stops the output, and the job continues.

    Args:
        address: The cluster's dashboard, `http://HOST:8265`.
        config: The league's file.
        arguments: Further arguments of the command.
        storage: Where the job stores its results.
        say: Prints a line.

    Raises:
        ConfigError: There is no such cluster, it cannot reach the storage, or the database's URL has a password.
        LeagueError: The job failed.
    """
    host = urlsplit(address).hostname
    if not address.startswith(("http://", "https://")) or host is None:
        raise ConfigError(f"--job: expected --address http://HOST:8265, the cluster's dashboard, got {address!r}")
    try:
        if host not in LOOPBACK:
            storage.check_reach({"here", host})
    except ConfigError as error:
        raise ConfigError(
            f"--job: {host} is another machine: set LEAGUE_DATABASE_URL to a PostgreSQL server, LEAGUE_ARTIFACTS to a"
            " directory that both mount, and LEAGUE_HOME to one on the cluster's head"
        ) from error
    storage.check_no_password("Ray's dashboard")
    silence_job_submission()
    client = _client(address)
    with tempfile.TemporaryDirectory() as directory:
        shutil.copy(config, directory)
        command = shlex.join(["league", "train", config.name, "--address", "auto", *arguments])
        # The same storage, and a PATH that includes this `league`.
        environment = storage.environment | {"PATH": f"${{PATH}}:{Path(sys.executable).parent}"}
        job = _begin(client, command, {"working_dir": directory, "env_vars": environment})
    say(f"Submitted job {job}. To stop it: ray job stop {job} --address {address}")
    try:
        asyncio.run(_follow(client, job, say))
    except KeyboardInterrupt:
        say(f"\nThe job continues. To follow it: ray job logs {job} --follow --address {address}")
        say(f"To stop it: ray job stop {job} --address {address}")
        raise
    info = client.get_job_info(job)
    if info.status is not JobStatus.SUCCEEDED:
        raise LeagueError(f"job {job}: {info.status.value.lower()}: {' '.join((info.message or '').split())}")


def _client(address: str) -> JobSubmissionClient:
    try:
        return JobSubmissionClient(address)
    except AuthenticationError as error:
        raise ConfigError(f"--job: {address} requires a token: set RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH") from error
    except (ConnectionError, RuntimeError) as error:
        reason = one_line(error)
        raise ConfigError(f"--job: no Ray dashboard at {address}: {reason}") from error


def _begin(client: JobSubmissionClient, command: str, runtime_env: dict[str, Any]) -> str:
    """Submit the job, retrying while a new cluster does not accept jobs yet."""
    deadline = time.monotonic() + STARTS_WITHIN
    while True:
        try:
            return str(client.submit_job(entrypoint=command, runtime_env=runtime_env))
        except RuntimeError as error:
            if NO_JOB_AGENT not in str(error) or time.monotonic() > deadline:
                raise LeagueError(f"the cluster did not accept the job: {one_line(error)}") from error
            time.sleep(0.5)


async def _follow(client: JobSubmissionClient, job: str, say: Callable[[str], None]) -> None:
    async for lines in client.tail_job_logs(job):
        say(lines.rstrip("\n"))
