"""The text of the pages HTTP reference and JSON documents.

The first has every call of the API with its parameters, bodies, responses and errors. It is made from the OpenAPI
document, and thereby from the declarations of the routes. The second has the documents that commands print with
`--json`. It is made from the classes of the records, and their docstrings.
"""

import re
from typing import Any

from pydantic import TypeAdapter

from evaluation.documents import EvaluationReport, Exploitability
from evaluation.gating.evidence import LATER, VerdictReport
from evaluation.gating.gate_result import CriterionReport
from evaluation.gating.nightly import NightlyReport
from evaluation.gating.verification import Verification
from evaluation.reporting.run_comparison import RunComparison
from serve_app.openapi.document import document
from serve_app.settings import ServeSettings

HEAD = """# HTTP reference

All calls of the [HTTP API](http.md), and the fields of their bodies and responses. A running server shows the same at
`/docs`, with examples for its policies, and as an OpenAPI 3.1 document at `/openapi.json`. [Errors](http.md#errors)
explains the codes.
"""
DOCUMENTS_HEAD = """# JSON documents

The fields of documents that commands print with `--json`. [JSON output](json.md) has examples, and the other commands.
"""
DOCUMENTS = {
    "`league compare RUN_A RUN_B --json`": RunComparison,
    "`league evaluate LEAGUE --json`": EvaluationReport,
    "`league exploitability REF --json`": Exploitability,
    "`league verify VERDICT --json`": Verification,
    "`league nightly --json`, each of `leagues`": NightlyReport,
}


def http_page() -> str:
    """The text of the page HTTP reference, in Markdown."""
    api = document(ServeSettings(), [])
    parts = [HEAD]
    for tag in api["tags"]:
        parts.append(f"## {tag['name']}\n\n{tag['description']}")
        for path, item in api["paths"].items():
            calls = {method: call for method, call in item.items() if method != "parameters"}
            parts += [_call(api, method, path, call) for method, call in calls.items() if tag["name"] in call["tags"]]
    schemas = api["components"]["schemas"].items()
    parts += ["## Documents", *(_schema(name, schema) for name, schema in sorted(schemas))]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


def documents_page() -> str:
    """The text of the page JSON documents, in Markdown."""
    models = (*DOCUMENTS.values(), CriterionReport)
    schemas = TypeAdapter.json_schemas([(model, "serialization", TypeAdapter(model)) for model in models])[1]["$defs"]
    rows = [(command, _type({"$ref": f"/{model.__name__}"})) for command, model in DOCUMENTS.items()]
    parts = [DOCUMENTS_HEAD, _table(("command", "document"), rows), "## Documents"]
    for name, schema in sorted(schemas.items()):
        fields, text = schema["properties"], schema["description"].replace("None", "null")
        # An entry of a docstring: `field, field[i]: description`.
        entry = rf"\s((?:(?:{'|'.join(fields)})\b(?:\[\w+\])*(?:, )?)+): "
        first, *entries = re.split(entry, text)
        for listed, description in zip(entries[::2], entries[1::2], strict=True):
            for field in listed.split(", "):
                sentence = f"`{field}`: {description}" if "[" in field else f"{description[0].upper()}{description[1:]}"
                fields[field.partition("[")[0]]["description"] = sentence
        if name == VerdictReport.__name__:
            schema["properties"] = {field: part for field, part in fields.items() if field not in LATER}
        parts.append(_schema(name, schema | {"description": first.strip()}))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _call(api: dict[str, Any], method: str, path: str, call: dict[str, Any]) -> str:
    parameters = [*api["paths"][path].get("parameters", ()), *call.get("parameters", ())]
    resolved = [_resolved(api, parameter) for parameter in parameters]
    rows = [(f"`{node['name']}`", _type(node["schema"]), node.get("description", "")) for node in resolved]
    parts = [f"### `{method.upper()} {path}`", f"**{call['summary']}.** {call.get('description', '')}"]
    parts.append(f"Scope: `{call['x-scope']}`." if "x-scope" in call else "Public: no key is needed.")
    parts += [_table(("parameter", "type", "description"), rows)] if rows else []
    if "requestBody" in call:
        parts.append(f"Body: {_content(call['requestBody'])}")
    replies = {status: _resolved(api, reply) for status, reply in call["responses"].items()}
    rows = [(status, _content(reply), reply["description"]) for status, reply in replies.items() if status < "400"]
    parts.append(_table(("status", "content", "description"), rows))
    errors = [f"{status} {codes}" for status, reply in replies.items() if (codes := _codes(reply))]
    return "\n\n".join([*parts, *([f"Errors: {'; '.join(errors)}."] if errors else [])])


def _resolved(api: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """The part of the document that a node refers to, or the node."""
    if "$ref" in node:
        _, _, kind, name = node["$ref"].split("/")
        node = api["components"][kind][name]
    return node


def _schema(name: str, schema: dict[str, Any]) -> str:
    parts = [f"### {name}", schema.get("description", "")]
    if "properties" not in schema:
        return "\n\n".join([*parts, f"Type: {_type(schema)}."])
    rows = [(f"`{field}`", _type(part), part.get("description", "")) for field, part in schema["properties"].items()]
    return "\n\n".join([*parts, _table(("field", "type", "description"), rows)])


def _content(node: dict[str, Any]) -> str:
    return ", ".join(
        _type(content["schema"]) if media == "application/json" else f"`{media}`"
        for media, content in node.get("content", {}).items()
    )


def _codes(reply: dict[str, Any]) -> str:
    schema = reply.get("content", {}).get("application/json", {}).get("schema", {})
    codes = [
        code for part in schema.get("allOf", ()) for code in part.get("properties", {}).get("code", {}).get("enum", ())
    ]
    return ", ".join(f"`{code}`" for code in codes)


def _type(schema: dict[str, Any]) -> str:
    """The type of a value in a few words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in schema or "oneOf" in schema:
        return " or ".join(dict.fromkeys(map(_type, schema.get("anyOf", schema.get("oneOf")))))
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    match schema.get("type"):
        case "array":
            items = schema.get("prefixItems") or [schema.get("items", {})]
            return f"list of {' and '.join(dict.fromkeys(map(_type, items)))}"
        case "object" if isinstance(schema.get("additionalProperties"), dict):
            return f"map to {_type(schema['additionalProperties'])}"
        case list() as kinds:
            return " or ".join(kinds)
        case str() as kind:
            return "time" if schema.get("format") == "date-time" else kind
        case _:
            return "any"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in line) + " |" for line in lines
    )


if __name__ == "__main__":
    print(http_page(), documents_page(), sep="\n")
