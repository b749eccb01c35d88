"""The model card of a version, computed from the registry: `README.md` of an exported Hugging Face folder.

The front matter is that of the Hub's model cards (https://huggingface.co/docs/hub/model-cards). Names, notes and
reasons are untrusted: in the text they are escaped, and in code they are literals of ASCII.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import yaml

from evaluation.documents import Exploitability, Standing
from evaluation.gating.criteria.exploitability import exploitability_bound
from evaluation.gating.evidence import verdict_of
from evaluation.matches.leaderboard import compute_leaderboard
from league.registry.registry import Registry
from league.registry.storage.manifest import PolicyManifest
from league.registry.storage.rows import VersionRow
from league.results.ledger import Ledger
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space, inputs, paths

MOST_STANDINGS = 10
"""Contestants of the leaderboard, besides the version itself."""
MOST_EVENTS = 20
"""Verdicts, and times when it became champion or was replaced: the newest ones."""
MOST_CHARACTERS = 80
"""Of a bound of a space."""


def model_card(registry: Registry, version: VersionRow) -> str:
    """Return the card of a version: interface, code that acts with it, results, training, environment and digests.

    Args:
        registry: Registry of the league.
        version: The version, not a mixture.

    Returns:
        Markdown with YAML front matter. All contestants under the league's current conditions are rated.

    Raises:
        UnknownLeague: The league was removed.
        StorageError: The registry failed.
    """
    manifest, standings = version.manifest, compute_leaderboard(registry, version.league)
    standing = next((row for row in standings if row.ref == version.ref), None)
    parts = [
        f"---\n{yaml.safe_dump(_front_matter(version, standing), sort_keys=False)}---",
        f"# {_code(version.ref)}",
        f"Version {version.number} of the league {_code(version.league)}, in the environment"
        f" {_code(manifest.environment.entry_point)}, as ONNX graphs. Made {version.created_at:%Y-%m-%d} with"
        f" {_code(manifest.algorithm)} from {manifest.steps:,} actions of experience. It can be run without the library"
        " that trained it.",
    ]
    if version.note is not None:
        parts.append(f"Note: {_text(version.note.text)}")
    if version.exploits is not None:
        parts.append(f"It is an exploiter: it was trained against {_code(version.exploits)} only.")
    parts.append("## Interface and use")
    for name, policy in manifest.policies.items():
        parts += _policy(version, name, policy)
    parts += [
        "The folder contains what a server needs: `league import LEAGUE FOLDER` adds it to a league with this"
        " environment, and `league serve` serves the league's versions.",
        "## Results",
        *_results(registry, version, standings),
        "## Training",
        _table(
            ("", ""),
            [
                ("algorithm", _code(manifest.algorithm)),
                ("experience", f"{manifest.steps:,} actions of all agents, parents' included"),
                ("parent", _code(f"{version.league}@{version.parent}") if version.parent is not None else "none"),
                ("seed", str(manifest.seed)),
                ("commit", _code(manifest.git_commit) if manifest.git_commit else "unknown"),
            ],
        ),
        _fenced("json", json.dumps(manifest.settings, indent=2)),
        "## Environment",
        _fenced("json", json.dumps(manifest.environment.model_dump(mode="json"), indent=2)),
        "Libraries: " + (", ".join(f"{_code(name)} {_text(at)}" for name, at in manifest.stack.items()) or "unknown"),
        "## Digests",
        _table(
            ("SHA-256 of", ""),
            [
                ("`manifest.json`", f"`{version.sha256}`"),
                ("the environment", _code(manifest.environment_digest)),
                ("the interface", f"`{manifest.interface.digest()}`"),
                *(
                    (_code(file), _code(manifest.files[file]))
                    for policy in manifest.policies.values()
                    for file in policy.files
                    if file in manifest.files
                ),
            ],
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _front_matter(version: VersionRow, standing: Standing | None) -> dict[str, Any]:
    entry_point = version.manifest.environment.entry_point
    metrics = []
    if standing is not None:
        metrics.append({"type": "score", "name": "mean score", "value": standing.score})
        if standing.rating is not None:
            metrics.append({"type": "elo", "name": f"Elo {_elo(standing)}", "value": standing.rating})
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    dataset = {"type": entry_point, "name": entry_point}
    results = [{"task": task, "dataset": dataset, "metrics": metrics}] if metrics else []
    return {
        "library_name": "onnx",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "multi-agent", "onnx", "policy-league"],
        **({"model-index": [{"name": version.ref, "results": results}]} if results else {}),
    }


def _policy(version: VersionRow, name: str, policy: PolicyManifest) -> list[str]:
    """The section of a policy: its tensors, and how to act with it."""
    agents = [agent for agent, of_agent in version.manifest.agents.items() if of_agent == name]
    leaves = inputs(policy.observation)
    rows = []
    for tensor in (*policy.inputs, *policy.outputs):
        meaning = ""
        if tensor.name == ACTION_MASK:
            meaning = "1 for legal actions"
        elif tensor.name in leaves:
            meaning = _values(leaves[tensor.name])
        elif tensor.name == "action":
            meaning = f"greedy action, {_values(policy.action)}"
        elif tensor.name == "action_dist_inputs":
            meaning = "inputs of the action distribution: masked logits or values, or means and log standard deviations"
        elif tensor.name.startswith("state_in_"):
            meaning = "recurrent state, zeros at the start of an episode"
        elif tensor.name.startswith("state_out_"):
            meaning = "recurrent state for the next step"
        shape = "batch" + "".join(f", {'any' if size is None else size}" for size in tensor.shape[1:])
        kind = "input" if tensor in policy.inputs else "output"
        rows.append((_code(tensor.name), kind, _code(tensor.dtype), shape, meaning))
    model = version.league if len(version.manifest.policies) == 1 else f"{version.league}.{name}"
    parity = policy.parity
    return [
        f"### Policy {_code(name)}",
        f"Acts for {', '.join(map(_code, agents))}. Its graph {_code(policy.file)} was compared with the trained"
        f" network on {parity.observations:,} observations: {parity.mismatches} other greedy actions,"
        f" {parity.near_ties} near ties, outputs that differ by at most {parity.max_difference:.2g}.",
        _table(("tensor", "", "dtype", "shape", "values"), rows),
        "With ONNX Runtime, in this folder:",
        _fenced("python", _acting(policy)),
        "From a server:",
        _fenced("python", _requesting(model, policy)),
    ]


def _values(space: Space) -> str:
    match space:
        case Box():
            low, high = (json.dumps(bound) for bound in (space.low, space.high))
            is_short = len(low + high) <= MOST_CHARACTERS
            return _text(f"from {low} to {high}".replace("null", "unbounded")) if is_short else "bounds in the manifest"
        case Discrete():
            return f"an integer from {space.start} to {space.start + space.n - 1}"
        case MultiDiscrete():
            sizes = json.dumps(space.nvec)
            return f"integers, as many as {_text(sizes)}" if len(sizes) <= MOST_CHARACTERS else "integers"
    return "zeros and ones"


def _acting(policy: PolicyManifest) -> str:
    tensors = ""
    for tensor in policy.inputs:
        shape = (1, *(size or 1 for size in tensor.shape[1:]))
        tensors += f"    {tensor.name!a}: {_array(tensor.name, tensor.dtype, shape)},\n"
    remember = (
        "\n# The state for the next step of the same episode:\n"
        "inputs |= {name: outputs[name.replace('_in_', '_out_')] for name in inputs if name.startswith('state_in_')}"
    )
    return (
        "import numpy as np\nimport onnxruntime\n\n"
        f"session = onnxruntime.InferenceSession({policy.file!a})\n"
        f"inputs = {{\n{tensors}}}\n"
        "names = [output.name for output in session.get_outputs()]\n"
        "outputs = dict(zip(names, session.run(names, inputs)))\n"
        'print(outputs["action"][0])' + (remember if policy.state else "")
    )


def _requesting(model: str, policy: PolicyManifest) -> str:
    leaves = inputs(policy.observation)
    observation = _nested(
        {
            path: f"{_array(name, leaves[name].dtype, leaves[name].shape)}.tolist()"
            for name, path in paths(policy.observation).items()
        }
    )
    url = f"http://127.0.0.1:8000/v1/policies/{model}/action"
    return (
        "import json\nfrom urllib.request import urlopen\n\nimport numpy as np\n\n"
        f"observation = {observation}\n"
        'body = json.dumps({"observation": observation}).encode()\n'
        f"with urlopen({url!a}, body) as response:\n"
        '    print(json.load(response)["action"])'
    )


def _nested(values: Mapping[tuple[str, ...], str]) -> str:
    """A literal of nested dictionaries. values: path of keys → code of the value."""
    if () in values:
        return values[()]
    keys = dict.fromkeys(path[0] for path in values)
    parts = (f"{key!a}: {_nested({path[1:]: code for path, code in values.items() if path[0] == key})}" for key in keys)
    return f"{{{', '.join(parts)}}}"


def _array(name: str, dtype: str, shape: tuple[int, ...]) -> str:
    """Code of an example: zeros, or a mask in which all actions are legal."""
    return f"np.{'ones' if name == ACTION_MASK else 'zeros'}({shape}, {dtype!a})"


def _results(registry: Registry, version: VersionRow, standings: Sequence[Standing]) -> list[str]:
    places = [
        (place, row) for place, row in enumerate(standings, 1) if place <= MOST_STANDINGS or row.ref == version.ref
    ]
    table = _table(
        ("place", "contestant", "Elo [95 %]", "score", "mean return", "games"),
        [
            (
                str(place),
                f"**{_code(row.ref)}**" if row.ref == version.ref else _code(row.ref),
                _elo(row),
                f"{row.score:.3f}",
                "–" if row.mean_return is None else f"{row.mean_return:.4g}",
                f"{row.games:,}",
            )
            for place, row in places
        ],
    )
    parts = ["No games were recorded."]
    if standings:
        parts = [
            f"Ratings are relative to a player of random moves, among {len(standings)} contestants. They and the"
            " scores, shares of all points, are from all games under the league's current conditions.",
            table,
        ]
    events = [
        event for event in registry.aliases.history(version.league) if version.number in (event.version, event.previous)
    ]
    if events:
        rows = [
            (
                f"{event.at:%Y-%m-%d}",
                "became champion"
                if event.version == version.number
                else f"replaced by {_code(f'{version.league}@{event.version}')}",
                _text(event.actor),
                _text(event.reason),
            )
            for event in events[:MOST_EVENTS]
        ]
        parts += ["### Champion", _table(("date", "", "by", "reason"), rows)]
    verdicts = [row for row in registry.verdicts.all(version.league) if row.candidate == version.number]
    if verdicts:
        parts.append("### Verdicts of the gate")
    for verdict in reversed(verdicts[-MOST_EVENTS:]):
        report = verdict_of(registry, verdict)
        parts.append(
            f"{verdict.opened_at:%Y-%m-%d}, against {_code(report.opponent)}, {report.games:,} games at α ="
            f" {report.alpha:.2g}: **{_text(report.outcome)}**. {_text(report.reason)}"
        )
        if (confirmed := report.confirmation) is not None:
            low, high = ("∞" if bound is None else f"{bound:+.0f}" for bound in confirmed.interval)
            parts.append(f"Confirmed in {confirmed.games:,} further games: {confirmed.elo:+.0f} [{low}, {high}] Elo.")
    if measured := _exploitability(registry, version):
        rows = [
            (
                _code(score.ref),
                f"{score.games:,}",
                f"{score.score:.3f} [{score.low:.3f}, {score.high:.3f}]",
                "–" if score.gain is None else str(score.gain),
            )
            for score in measured.exploiters
        ]
        parts += [
            "### Exploitability",
            f"A best response scores at least {measured.bound:.3f}, as policies that were trained against it show:",
            _table(("exploiter", "games", "score [95 %]", "return gain [95 %]"), rows),
        ]
    return parts


def _exploitability(registry: Registry, version: VersionRow) -> Exploitability | None:
    """Learned exploitability from the last `league exploitability` under the current conditions; None without any."""
    ledger, exploiters = (
        Ledger(registry),
        [row.ref for row in registry.versions.exploiters(version.league, [version.ref])],
    )
    for schedule in reversed(ledger.counted(version.league, registry.leagues.get(version.league).conditions)):
        opponents = [ref for ref in exploiters if ref in schedule.contestants]
        if schedule.kind == "challenge" and version.ref in schedule.contestants and opponents:
            matches = ledger.matches(league=version.league, schedule=schedule.id)
            if len(matches) == schedule.length:
                return exploitability_bound(version.ref, opponents, matches)
    return None


def _elo(standing: Standing) -> str:
    if standing.rating is None:
        return "–"
    low_high = standing.interval
    return f"{standing.rating:+.0f}" + ("" if low_high is None else f" [{low_high[0]:+.0f}, {low_high[1]:+.0f}]")


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _fenced(language: str, code: str) -> str:
    """A block of code, whose lines are not text of others: none can close the fence."""
    return f"```{language}\n{code}\n```"


def _code(name: str) -> str:
    """An identifier as code, where it cannot end it or the cell of a table."""
    name = _printable(name)
    return _text(name) if "`" in name or "|" in name or not name.strip() else f"`{name}`"


def _text(text: str) -> str:
    """Text of others, without markup, links and mentions."""
    return re.sub(r"([\\`*_\[\]<>~$&#@]|:(?=//))", r"\\\1", _printable(text)).replace("|", "&#124;")


def _printable(text: str) -> str:
    """Text in one line, without characters that control its direction or the terminal."""
    return "".join(character if character.isprintable() else " " for character in text)
