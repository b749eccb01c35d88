"""Model cards."""

import io
import json
import re
import subprocess
import sys
import urllib.request
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from markdown_it.token import Token

from evaluation.matches.tournament import play_schedule
from evaluation.reporting.model_card import model_card
from evaluation.schedules.builders import gauntlet
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.interface import AgentInterface
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_folder
from league.registry.storage.rows import Note, VersionRow
from league.spaces import Box, DictSpace, Discrete
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import MIDDLING, STRONG, WEAK, league_of, promote
from tests.support.leagues.reported_league import league_after_nightly
from tests.support.servers.replicas import replica

PRODUCT = ("league", "evaluation", "training", "serve_app", "policy_league", "policy_league_client")


def parsed(card: str) -> tuple[dict[str, object], list[Token]]:
    """The front matter, and the tokens of the text."""
    _, matter, text = card.split("---\n", 2)
    return yaml.safe_load(matter), MarkdownIt("commonmark").enable("table").parse(text)


def code(card: str, language: str) -> list[str]:
    return [token.content for token in parsed(card)[1] if token.type == "fence" and token.info == language]


def run_alone(snippet: str, folder: Path) -> str:
    """Run code of a card in its folder, in a process that cannot have imported the product."""
    check = f"import sys\nassert not {{*{PRODUCT}}} & {{*sys.modules}}\n"
    done = subprocess.run([sys.executable, "-c", snippet + check], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_code_of_an_exported_folder_acts(tmp_path: Path) -> None:
    """That of a recurrent policy passes its state on."""
    registry = league_of(tmp_path / "home", WEAK)
    version = registry.versions.get("tictactoe", 1)
    card = model_card(registry, version)
    write_folder({"README.md": card.encode()} | exported_files(version, registry.artifacts), tmp_path / "folder")
    assert run_alone(code(card, "python")[0], tmp_path / "folder") in {str(square) for square in range(9)}
    assert version.sha256 in card
    assert "No games were recorded." in card
    document = {"league": "spread", "environment": {"entry_point": "mpe2.simple_spread_v3"}, "sides": {"team": ["*"]}}
    config = LeagueConfig.from_mapping(document)
    registry.leagues.register(config, described := interface(config))
    graph = tictactoe.linear(described.of_policy(described.policy_ids[0]), memory=True)
    version = tictactoe.publish(registry, graph, league="spread")
    card = model_card(registry, version)
    write_folder({"README.md": card.encode()} | exported_files(version, registry.artifacts), tmp_path / "recurrent")
    snippet = f"{code(card, 'python')[0]}\nprint(inputs['state_in_0'])\n"
    assert run_alone(snippet, tmp_path / "recurrent").endswith("[[1.]]")


def test_the_request_of_a_card_is_answered_by_a_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = league_of(tmp_path, WEAK)
    promote(registry, 1)
    snippet = code(model_card(registry, registry.versions.get("tictactoe", 1)), "python")[1]
    with replica(registry.storage) as server:

        def urlopen(url: str, body: bytes) -> io.BytesIO:
            path = url.removeprefix("http://127.0.0.1:8000")
            return io.BytesIO(server.post(path, content=body).raise_for_status().content)

        monkeypatch.setattr(urllib.request, "urlopen", urlopen)
        printed: list[object] = []
        exec(snippet, {"print": printed.append})
    assert printed[0] in range(9)


@pytest.mark.slow
def test_results_are_those_of_the_registry(tmp_path: Path) -> None:
    with league_after_nightly(tmp_path) as registry:
        card = model_card(registry, registry.versions.get("tictactoe", 3))
    matter, _ = parsed(card)
    (entry,) = matter["model-index"]  # type: ignore[misc]
    assert entry["name"] == "tictactoe@3"
    metrics = {metric["type"]: metric["value"] for metric in entry["results"][0]["metrics"]}
    assert f"**`tictactoe@3`** | {metrics['elo']:+.0f} [" in card
    assert re.search(r"against `tictactoe@2`, \d+ games at α = 0\.05: \*\*promote\*\*\. Stronger", card)
    assert "| replaced by `tictactoe@1` |" in card
    assert re.search(r"Confirmed in 40 further games: \+\d+ \[\+\d+, \+\d+\] Elo", card)


def test_exploitability_is_that_of_its_exploiters(tmp_path: Path) -> None:
    registry = league_of(tmp_path, MIDDLING)
    tictactoe.publish(registry, STRONG, exploits="tictactoe@1")
    row = registry.leagues.get("tictactoe")
    schedule = gauntlet(row.config, row.interface, ["tictactoe@1"], ["tictactoe@2"], 5, 0, kind="challenge")
    assert "Exploitability" not in model_card(registry, registry.versions.get("tictactoe", 1))
    play_schedule(schedule, registry=registry, workers=0)
    card = model_card(registry, registry.versions.get("tictactoe", 1))
    assert re.search(r"A best response scores at least 0\.\d+.*\n\n.*\n.*\n\| `tictactoe@2` \| 10 \|", card)
    exploiter = model_card(registry, registry.versions.get("tictactoe", 2))
    assert "It is an exploiter: it was trained against `tictactoe@1` only." in exploiter


def version_with(version: VersionRow, text: str) -> VersionRow:
    """The version with `text` wherever others could write it."""
    policy = version.manifest.policies["shared"]
    assert isinstance(policy.observation, DictSpace)
    spaces = {f"{text}key": Box(dtype="int8", shape=(2,), low=0, high=1), "other": Discrete(n=2)}
    observation = DictSpace(spaces=spaces)
    tensors = tuple(tensor.model_copy(update={"name": f"observation.{text}"}) for tensor in policy.inputs)
    agents = {f"{text}agent": AgentInterface(observation=observation, action=policy.action)}
    manifest = version.manifest.model_copy(
        update={
            "algorithm": text,
            "git_commit": text,
            "settings": {text: text},
            "stack": {text: text},
            "environment": version.manifest.environment.model_copy(
                update={"entry_point": text, "kwargs": {text: text}}
            ),
            "interface": version.manifest.interface.model_copy(
                update={"agents": agents, "policies": dict.fromkeys(agents, text)}
            ),
            "policies": {text: policy.model_copy(update={"observation": observation, "inputs": tensors, "file": text})},
        }
    )
    return replace(version, manifest=manifest, note=Note(text, "ada", datetime.now(UTC)))


def structure(tokens: list[Token]) -> list[str]:
    """Blocks of a text, and the kinds of its inline markup other than code and line breaks."""
    inline = {"text", "code_inline", "softbreak"}
    return [
        kind
        for token in tokens
        for kind in (token.type, *(child.type for child in token.children or () if child.type not in inline))
    ]


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> tuple[Registry, VersionRow, list[str]]:
    """A version, and the structure of its card."""
    registry = league_of(tmp_path_factory.mktemp("home"), WEAK)
    version = registry.versions.get("tictactoe", 1)
    return registry, version, structure(parsed(model_card(registry, version_with(version, "plain")))[1])


@settings(max_examples=20, deadline=None)
@given(text=st.text("`|\\*_[]()<>&~$#@:/!-=+.{}\"'\n\r\t\u202e\u2028 aw1é", min_size=1, max_size=12))
def test_text_of_others_is_no_markup(published: tuple[Registry, VersionRow, list[str]], text: str) -> None:
    registry, version, plain = published
    card = model_card(registry, version_with(version, text))
    _, tokens = parsed(card)
    assert structure(tokens) == plain
    assert not [token.type for token in tokens if "html" in token.type]
    for snippet in code(card, "python"):
        compile(snippet, "card", "exec")
    for block in code(card, "json"):
        json.loads(block)


def test_names_are_kept_in_the_front_matter_and_in_code(tmp_path: Path) -> None:
    registry, text = league_of(tmp_path, WEAK, MIDDLING), "---\nlicense: x\n'\"```\n| é"
    row = registry.leagues.get("tictactoe")
    schedule = gauntlet(row.config, row.interface, ["tictactoe@1"], ["tictactoe@2"], 2, 0)
    play_schedule(schedule, registry=registry, workers=0)
    card = model_card(registry, version_with(registry.versions.get("tictactoe", 1), text))
    matter = yaml.safe_load(re.match(r"---\n(.*?)\n---\n", card, re.DOTALL)[1])
    assert matter["model-index"][0]["results"][0]["dataset"]["name"] == text
    assert "license" not in matter
    assert f"onnxruntime.InferenceSession({text!a})" in code(card, "python")[0]
