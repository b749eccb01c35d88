"""A game in a page of another origin acts through the server, with its key."""

import re

import numpy as np
import pytest
from playwright.sync_api import Error

from tests.support.clients.browsers import Served, Tab
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.servers.replicas import QUICK
from tests.support.servers.streaming import listening

pytestmark = pytest.mark.slow  # a browser and a server take all cores

BODY = {"observation": {"observation": np.zeros((3, 3, 2), int).tolist(), "action_mask": [1] * 9}}
ACT = """async ([url, key, body]) => {
  const action = await fetch(url, {
    method: "POST",
    headers: { "content-type": "application/json", authorization: "Bearer " + key },
    body: JSON.stringify(body),
  });
  const replica = action.headers.get("x-league-replica");
  const stream = new WebSocket(url.replace("http", "ws").replace("/action", "/stream"), [
    "policy-league",
    "policy-league.key." + key,
  ]);
  const message = await new Promise((resolve, reject) => {
    stream.onopen = () => stream.send(JSON.stringify(body));
    stream.onmessage = (event) => resolve(event.data);
    stream.onerror = () => reject(new Error("the stream was refused"));
  });
  return [action.status, replica, await action.json(), JSON.parse(message)];
}"""


def test_a_listed_page_acts_over_http_and_a_stream(tab: Tab, served: Served) -> None:
    page = tab.open("/v2/health/live")  # a document without a policy of its own, on another port
    settings = QUICK.model_copy(update={"cors_origins": [served.url]})
    with listening(served.registry.storage, settings) as other:
        url = f"{other.url}/v1/policies/{LEAGUE}/action"
        status, replica, action, message = page.evaluate(ACT, [url, served.keys["everything"], BODY])
        assert (status, replica) == (200, "replica-1")
        assert action == message
        assert 0 <= action["action"] < 9
    with listening(served.registry.storage, QUICK) as closed, pytest.raises(Error, match="Failed to fetch"):
        page.evaluate(ACT, [f"{closed.url}/v1/policies/{LEAGUE}/action", served.keys["everything"], BODY])
    tab.errors[:] = [error for error in tab.errors if not re.search("CORS|Failed to load resource", error)]
