"""JSON documents that several routes return: evaluations, verdicts and traffic settings."""

from typing import Any

from league.registry.storage.mixture import Mixture
from league.registry.storage.rows import EvaluationRow, Portion, Traffic, VerdictRow

OPEN = "open"


def evaluation_document(row: EvaluationRow) -> dict[str, Any]:
    """An evaluation as JSON, with its result."""
    return evaluation_summary(row) | {"result": row.result}


def evaluation_summary(row: EvaluationRow) -> dict[str, Any]:
    instants = {"created_at": row.created_at, "started_at": row.started_at, "ended_at": row.ended_at}
    return {
        "league": row.league,
        "evaluation": row.id,
        "state": row.state,
        "request": row.request,
        "progress": row.progress,
        "error": row.error,
        "actor": row.actor,
        "reason": row.reason,
        "workers": row.workers,
        "stopped_by": row.stopped_by,
        "heartbeat_at": row.heartbeat_at and row.heartbeat_at.isoformat(),
    } | {name: instant and instant.isoformat() for name, instant in instants.items()}


def verdict_summary(row: VerdictRow) -> dict[str, Any]:
    """The decision of a verdict as JSON."""
    return {
        "verdict": row.id,
        "candidate": f"{row.league}@{row.candidate}",
        "opponent": row.champion,
        "outcome": row.outcome or OPEN,
        "promoted": bool((row.evidence or {}).get("promoted")),
        "opened_at": row.opened_at.isoformat(),
        "closed_at": row.closed_at and row.closed_at.isoformat(),
    }


def members_document(mixture: Mixture) -> list[dict[str, Any]]:
    """The members of a mixture as JSON."""
    return [{"version": member.version, "probability": member.probability} for member in mixture.members]


def traffic_document(setting: Traffic) -> dict[str, Any]:
    """A traffic setting as JSON."""
    return {
        "league": setting.league,
        "setting": setting.id,
        "canary": _portion_document(setting.canary),
        "shadow": _portion_document(setting.shadow),
        "actor": setting.actor,
        "reason": setting.reason,
        "at": setting.at and setting.at.isoformat(),
    }


def _portion_document(portion: Portion | None) -> dict[str, Any] | None:
    return None if portion is None else {"version": portion.version, "share": portion.share}
