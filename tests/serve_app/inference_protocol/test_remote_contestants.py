"""Remote models as contestants, against a served version of our own."""

from typing import Any

import numpy as np
import pytest

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch
from league.errors import ConfigError, EnvironmentMismatch, InvalidReference, RemoteError, UnknownPolicy
from league.interface import AgentInterface, Interface
from league.policies.loading import contestant, pinned, requested
from league.policies.open_inference import OpenInferencePolicy, fixed_version
from league.refs import RemoteRef, parse_ref
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import Box, Discrete
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.servers.protocol_servers import Address, InProcess
from training.sampling.opponents import OpponentPolicy, Opponents


def interface_of(storage: Storage, league: str) -> Interface:
    registry = Registry.open(storage)
    try:
        return registry.leagues.get(league).interface
    finally:
        registry.close()


def remote(replica: Address, model: str) -> RemoteRef:
    return RemoteRef(f"http://{replica.http}", model)


@pytest.mark.parametrize("model", ["board", "vector", "nested", "choice", "pistons"])
def test_a_remote_model_acts_as_the_version(replica: Address, leagues: Storage, model: str) -> None:
    policy, signature = policy_of(leagues, model)
    arrays = observations(signature, 5)
    found = contestant(str(remote(replica, model)), None, interface_of(leagues, model))
    for _, acting in found.values():
        actions = acting.act(arrays).actions
        np.testing.assert_array_equal(actions, policy.act(arrays).actions)


def test_a_key_is_sent_only_to_the_server_that_it_is_for(
    replica: InProcess, leagues: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = list[str | None]()
    admit = replica.server.access.admission

    def record(scope: Any, path: str) -> Any:
        admission = admit(scope, path)
        received.append(None if admission.headers.token is None else admission.headers.token.decode())
        return admission

    monkeypatch.setattr(replica.server.access, "admission", record)
    host = replica.http.partition(":")[2]
    interface = interface_of(leagues, "board")
    for variable, sent in (
        (f"http://other.example=wrong http://127.0.0.1:{host}/=right=", "right="),
        (f"https://{replica.http}=wrong http://127.0.0.1:1=wrong", None),
        ("", None),
    ):
        monkeypatch.setenv("LEAGUE_REMOTE_API_KEY", variable)
        fixed_version(remote(replica, "board"), interface)
        assert set(received) == {sent}
        received.clear()
    for variable in ("secret", "secret==", f"http://{replica.http}", f"http://{replica.http}="):
        monkeypatch.setenv("LEAGUE_REMOTE_API_KEY", variable)
        with pytest.raises(ConfigError, match="expected SERVER=KEY") as caught:
            fixed_version(remote(replica, "board"), interface)
        assert "secret" not in str(caught.value)


def test_large_batches_are_split(replica: Address, leagues: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("league.policies.open_inference.MAX_ROWS", 8)  # the server's limit in these tests
    policy, signature = policy_of(leagues, "vector")
    arrays = observations(signature, 17)
    ((_, acting), *_) = contestant(str(remote(replica, "vector")), None, interface_of(leagues, "vector")).values()
    np.testing.assert_array_equal(acting.act(arrays).actions, policy.act(arrays).actions)


def test_recurrent_state_is_sent_back(replica: Address, leagues: Storage) -> None:
    ((_, acting), *_) = contestant(str(remote(replica, "memory")), None, interface_of(leagues, "memory")).values()
    arrays, state, actions = {"observation": np.ones((2, 1), np.float32)}, None, []
    for _ in range(4):
        answer = acting.act(arrays, state=state)
        state = answer.state
        actions.append(answer.actions.tolist())
    assert actions == [[0, 0], [0, 0], [1, 1], [1, 1]]


def test_a_recurrent_model_remembers_as_an_opponent_in_training(replica: Address, leagues: Storage) -> None:
    ref = str(remote(replica, "memory"))
    interface = interface_of(leagues, "memory")
    opponents = Opponents([OpponentConfig(ref=ref, share=1.0)], interface, None, num_envs=2)
    opponent = OpponentPolicy(ref, interface.policy_ids[0])
    batch = Batch(np.arange(2), np.zeros(2, np.int64), {"observation": np.ones((2, 1), np.float32)}, np.zeros(2))

    def act() -> list[int]:
        return opponents.act(opponent, batch, np.random.default_rng(0)).tolist()

    assert [act() for _ in range(3)] == [[0, 0], [0, 0], [1, 1]]
    opponents.forget(np.array([0]))
    assert act() == [0, 1]


def test_a_remote_model_is_pinned_to_the_version_that_answers(replica: Address, leagues: Storage) -> None:
    fixed = fixed_version(remote(replica, "board"), interface_of(leagues, "board"))
    assert str(fixed) == f"http://{replica.http}/v2/models/board/versions/1"
    registry = Registry.open(leagues)
    assert pinned(f"http://{replica.http}/v2/models/board/versions/champion", "board", registry) == str(fixed)
    registry.close()


def test_each_policy_has_its_model(replica: Address, leagues: Storage) -> None:
    fixed = fixed_version(remote(replica, "duo.{policy}"), interface_of(leagues, "duo"))
    assert str(fixed) == f"http://{replica.http}/v2/models/duo.{{policy}}/versions/1"


def test_a_model_of_another_interface_is_refused(replica: Address, leagues: Storage) -> None:
    with pytest.raises(EnvironmentMismatch, match=r"has the input observation FP32 \[-1, 2\]: expected observation"):
        fixed_version(remote(replica, "vector"), interface_of(leagues, "board"))


def test_changed_metadata_are_another_contestant(replica: Address, leagues: Storage) -> None:
    changed = RemoteRef(f"http://{replica.http}", "board", digest="0" * 12)
    with pytest.raises(EnvironmentMismatch, match="have changed"):
        contestant(str(changed), None, interface_of(leagues, "board"))


def test_an_unknown_model_is_reported(replica: Address, leagues: Storage) -> None:
    with pytest.raises(RemoteError, match="/v2/models/nothing returned status 404"):
        fixed_version(remote(replica, "nothing"), interface_of(leagues, "board"))


def test_an_unreachable_server_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("league.policies.open_inference.RETRY_DEADLINE", 0.0)
    spaces = AgentInterface(observation=Box(dtype="float32", shape=(2,), low=None, high=None), action=Discrete(n=2))
    with pytest.raises(RemoteError, match="/v2/models/gone cannot be reached"):
        OpenInferencePolicy(RemoteRef("http://127.0.0.1:1", "gone"), "shared", spaces)


def test_requests_may_name_configured_models_only(leagues: Storage) -> None:
    registry = Registry.open(leagues)
    with pytest.raises(UnknownPolicy, match="its remote models: none"):
        requested("http://127.0.0.1:1/v2/models/board", "board", registry)
    registry.close()


@pytest.mark.parametrize(
    "text",
    [
        "http://host:8000/v2/models/board",
        "https://host/prefix/v2/models/board.{policy}/versions/7",
        "http://host:8000/v2/models/board#0123456789ab",
    ],
)
def test_references_are_written_as_they_are_read(text: str) -> None:
    parsed = parse_ref(text)
    assert isinstance(parsed, RemoteRef)
    assert str(parsed) == text


@pytest.mark.parametrize(
    "text", ["http://host:8000", "http://user@host/v2/models/m", "http://host/v2/models/a{b}", f"http://{'h' * 300}"]
)
def test_other_urls_are_refused(text: str) -> None:
    with pytest.raises(InvalidReference):
        parse_ref(text)
