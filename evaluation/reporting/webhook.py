"""Posts the summary of nightly runs to a webhook as JSON. Chat programs show its `text`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import httpx

from evaluation.gating.nightly import NightlyReport
from league.errors import ConfigError, RemoteError, one_line
from policy_league_client.loopback import is_loopback
from policy_league_client.proxies import usable_proxies

ATTEMPTS = 3
SECONDS = 10.0


def deliver(url: str, summary: Sequence[str], reports: Sequence[NightlyReport]) -> None:
    """POST `{"text": summary, "leagues": reports}` to `url` with retries.

    Raises ConfigError for an invalid URL, and RemoteError if all attempts fail. The nightly run stays valid.
    """
    document = {"text": "\n".join(summary), "leagues": [report.to_json() for report in reports]}
    fault = ""
    try:
        is_local = is_loopback(httpx.URL(url).host)
        with usable_proxies():
            client = httpx.Client(timeout=SECONDS, trust_env=not is_local)
        with client:
            for _ in range(ATTEMPTS):
                fault = _post(client, url, document)
                if not fault:
                    return
    except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
        raise ConfigError(f"--webhook {url!r} is not a valid URL: {error}") from error
    raise RemoteError(f"the webhook did not accept the summary of the nightly run in {ATTEMPTS} attempts: {fault}")


def _post(client: httpx.Client, url: str, document: Mapping[str, object]) -> str:
    """Return why a server did not accept a document, an empty string if it did."""
    try:
        answer = client.post(url, json=document)
    except httpx.UnsupportedProtocol:
        raise
    except httpx.HTTPError as error:
        return one_line(error)
    return "" if answer.is_success else f"status {answer.status_code}"
