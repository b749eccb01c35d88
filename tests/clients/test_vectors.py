"""The files of `clients/vectors` are what the Python client and the server send and read.

The tests of every client encode and decode them.
"""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml

from league.environments.external.messages import Abandoned, Hello, MessageCodec, Reports, abandon, play, refusal
from league.errors import InvalidInput
from league.interface import AgentInterface
from policy_league_client.requests import ActionRequest, BatchActionRequest, to_json
from policy_league_client.seeds import derive
from policy_league_client.simulator import ActionRows, Report, SimulatorConnection
from serve_app.inference.stream_codec import RESPONSE, encode_request, parse_request
from serve_app.live_versions.policies import ActionOptions

FOLDER = Path(__file__).parents[2] / "clients/vectors"
VECTORS = json.loads((FOLDER / "vectors.json").read_text())


def cases(key: str) -> Any:
    return pytest.mark.parametrize("case", VECTORS[key], ids=lambda case: case["file"])


def array(tensor: dict[str, Any]) -> np.ndarray:
    return np.array(tensor["data"], tensor["dtype"]).reshape(tensor["shape"])


def value(part: Any) -> Any:
    """The value of an observation, with arrays in place of their descriptions."""
    if not isinstance(part, dict):
        return part
    return array(part) if "dtype" in part else {key: value(inner) for key, inner in part.items()}


@cases("requests")
def test_json_requests(case: dict[str, Any]) -> None:
    options = {key: case[key] for key in ("explore", "probabilities", "state") if key in case}
    if "observation" in case:
        seed = int(case["seed"]) if "seed" in case else None
        body = ActionRequest.build(value(case["observation"]), "base64", seed=seed, **options).body
    else:
        rows = [value(row) for row in case["observations"]]
        body = BatchActionRequest.build(rows, "base64", seed=list(map(int, case["seed"])), **options).body
    assert json.loads(to_json(body)) == json.loads((FOLDER / case["file"]).read_text())


@cases("binary_requests")
def test_binary_requests(case: dict[str, Any]) -> None:
    message, tensors = (FOLDER / case["file"]).read_bytes(), [array(tensor) for tensor in case["inputs"]]
    seed, reset = int(case["seed"]) if "seed" in case else None, case["reset"]
    request = parse_request(message, max_batch=2)
    assert (request.rows, request.options) == (case["rows"], ActionOptions(case.get("explore"), seed))
    assert bytes(request.tensors) == b"".join(tensor.tobytes() for tensor in tensors)
    if isinstance(reset, list):
        assert request.resets is not None
        assert (request.reset, request.resets.tolist()) == (False, reset)
    else:
        assert (request.reset, request.resets) == (reset, None)
        assert message == encode_request(tensors, case["rows"], seed, case.get("explore"), reset)


@cases("binary_responses")
def test_binary_responses(case: dict[str, Any]) -> None:
    header = RESPONSE.pack(1, 0, 0, case["rows"], case["version"], 0)
    assert (FOLDER / case["file"]).read_bytes() == header + array(case["actions"]).tobytes()


def test_derived_seeds() -> None:
    for case in VECTORS["seeds"]:
        assert derive(int(case["seed"]), case["step"]) == int(case["derived"])


SIMULATOR = json.loads((FOLDER / "simulator.json").read_text())
MESSAGES = [
    pytest.param(message, id=f"{i}-{message['json']['type']}") for i, message in enumerate(SIMULATOR["messages"])
]
CODEC = MessageCodec({agent: AgentInterface.model_validate(spaces) for agent, spaces in SIMULATOR["agents"].items()})


@pytest.mark.parametrize("message", MESSAGES)
def test_messages_of_simulators_have_the_documented_form(message: dict[str, Any]) -> None:
    document = yaml.safe_load((FOLDER.parent / "asyncapi.yaml").read_text())
    payload = document["components"]["messages"][message["json"]["type"]]["payload"]
    jsonschema.validate(message["json"], payload | {"components": document["components"]})


@pytest.mark.parametrize("message", [case for case in MESSAGES if case.values[0]["from"] == "simulator"])
def test_what_a_simulator_sends(message: dict[str, Any]) -> None:
    document = message["json"]
    text = json.dumps(document)
    if document["type"] == "hello":
        assert CODEC.hello(text) == Hello("duel", "1.2", 2, binary=True)
        return
    read = CODEC.read(text)
    if isinstance(read, Abandoned):
        assert read.episodes == document["episodes"]
        return
    assert (flattened(read), read.over) == (flattened(binary := CODEC.read(bytes.fromhex(message["hex"]))), binary.over)
    connection = Recorded()
    reports = [
        (row["episode"], Report(**{key: row[key] for key in row if key != "episode"})) for row in document["reports"]
    ]
    connection.report(reports, document["over"])
    assert [sent.hex() for sent in connection.sent] == [message["hex"]]


def flattened(read: Reports | Abandoned) -> list[Any]:
    assert isinstance(read, Reports)
    rows = []
    for part in read.rows:
        columns = part.envs, part.agents, part.rewards, part.terminations, part.truncations
        for i in range(len(part.envs)):
            observations = [(name, array[i].tolist()) for name, array in part.observations.items()]
            rows.append(([column[i].item() for column in columns], observations))
    return sorted(rows)


@pytest.mark.parametrize("message", [case for case in MESSAGES if case.values[0]["from"] == "server"])
def test_what_a_simulator_gets(message: dict[str, Any]) -> None:
    document = message["json"]
    match document["type"]:
        case "welcome":
            assert json.loads(CODEC.welcome("game")) == document
        case "play":
            starts = document["episodes"]
            sent = play([start["episode"] for start in starts], [start["seed"] for start in starts])
            assert json.loads(sent) == document
        case "abandon":
            assert json.loads(abandon(document["episodes"])) == document
        case "error":
            assert json.loads(refusal(InvalidInput(document["message"]))) == document
        case "actions":
            connection = Recorded()
            for arrived in (json.dumps(document), bytes.fromhex(message["hex"])):
                connection.arriving.append(arrived)
                rows = connection.receive()
                assert isinstance(rows, ActionRows)
                names = [connection.agents[agent] for agent in rows.agents]
                documents = zip(rows.episodes.tolist(), names, rows.actions.tolist(), strict=True)
                assert [dict(zip(("episode", "agent", "action"), row, strict=True)) for row in documents] == document[
                    "actions"
                ]
                for is_binary, expected in ((False, json.dumps(document)), (True, bytes.fromhex(message["hex"]))):
                    arguments = rows.layout, rows.episodes, rows.agents, rows.actions
                    written = CODEC.actions(*arguments, binary=is_binary)
                    assert written == expected or json.loads(written) == json.loads(expected)


class Recorded(SimulatorConnection):
    """A connection whose messages are kept, and that receives what is in `arriving`."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.arriving: list[str | bytes] = []
        self._connection: Any = self
        self._binary = True
        self._read_welcome(json.loads(CODEC.welcome("game")))

    def send(self, message: bytes) -> None:
        self.sent.append(message)

    def recv(self, timeout: float) -> str | bytes:
        del timeout
        return self.arriving.pop()
