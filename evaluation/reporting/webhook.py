"""Posts the summary of nightly runs to a webhook as JSON. Chat programs show its `text`."""

from __future__ import annotations

from collections.abc import Sequence

import httpx

from evaluation.gating.nightly import NightlyReport
from league.errors import ConfigError, RemoteError, one_line

ATTEMPTS = 3
SECONDS = 10.0


def deliver(url: str, summary: Sequence[str], reports: Sequence[NightlyReport]) -> None:
    """POST `{"text": summary, "leagues": reports}` to `url` with retries.

    Raises ConfigError for an invalid URL, and RemoteError if all attempts fail. The nightly run stays valid.
    """
    document = {"text": "\n".join(summary), "leagues": [report.to_json() for report in reports]}
    fault = ""
    for _ in range(ATTEMPTS):
        try:
            answer = httpx.post(url, json=document, timeout=SECONDS)
        except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
            raise ConfigError(f"--webhook {url!r} is not a valid URL: {error}") from error
        except httpx.HTTPError as error:
            fault = one_line(error)
            continue
        if answer.is_success:
            return
        fault = f"status {answer.status_code}"
    raise RemoteError(f"the webhook did not accept the summary of the nightly run in {ATTEMPTS} attempts: {fault}")
