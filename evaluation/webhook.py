"""Tells somebody of a night: one POST of JSON, whose `text` is what chat programs show."""

from __future__ import annotations

from collections.abc import Sequence

import httpx

from evaluation.report import NightReport
from league.errors import ConfigError, RemoteError

ATTEMPTS = 3
SECONDS = 10.0


def deliver(url: str, summary: Sequence[str], reports: Sequence[NightReport]) -> None:
    """POST `{"text": summary, "leagues": reports}` to `url`, again where that fails.

    Raises ConfigError for what is no URL, and RemoteError if nobody takes it; the night is over and kept all the same.
    """
    document = {"text": "\n".join(summary), "leagues": [report.to_json() for report in reports]}
    fault = ""
    for _ in range(ATTEMPTS):
        try:
            answer = httpx.post(url, json=document, timeout=SECONDS)
        except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
            raise ConfigError(f"--webhook {url!r} is no URL that can be posted to: {error}") from error
        except httpx.HTTPError as error:
            fault = str(error) or type(error).__name__
            continue
        if answer.is_success:
            return
        fault = f"it answered {answer.status_code}"
    raise RemoteError(f"the webhook did not take the night's summary in {ATTEMPTS} attempts: {fault}")
