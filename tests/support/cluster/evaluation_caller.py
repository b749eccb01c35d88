"""Starts an evaluation of two versions over HTTP, follows it to its end, and prints it as JSON.

Arguments: base URL, API key with the scope `evaluate`, league, matches of each pair.
"""

import sys
from typing import Any

import httpx

from tests.support.waiting import until

ENDED = ("done", "failed", "stopped")
DEADLINE = 200.0
"""Seconds."""


def main() -> None:
    """Follow one evaluation."""
    url, key, league, blocks = sys.argv[1:]
    request = {"contestants": [f"{league}@1", f"{league}@2"], "blocks": int(blocks)}
    headers = {"x-api-key": key, "idempotency-key": "cluster"}
    with httpx.Client(base_url=url, headers=headers, timeout=30, trust_env=False) as client:
        until(lambda: _is_ready(client), DEADLINE)  # HAProxy may start later on this node than on the others
        started = client.post(f"/v1/leagues/{league}/evaluations", json=request)
        assert started.status_code == 202, started.text
        path = f"/v1/leagues/{league}/evaluations/{started.json()['evaluation']}"
        newest: dict[str, Any] = {}

        def has_ended() -> bool:
            nonlocal newest
            response = client.get(path)
            assert response.status_code == 200, response.text
            newest = response.json()
            return newest["state"] in ENDED

        until(has_ended, DEADLINE)
        print(client.get(path).text)


def _is_ready(client: httpx.Client) -> bool:
    try:
        return client.get("/v1/health/ready").status_code == 200
    except httpx.TransportError:
        return False


if __name__ == "__main__":
    main()
