"""`league traffic`: canary and shadow versions of a league."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.errors import InvalidInput
from league.refs import CheckpointRef, check_slug, parse_version
from policy_league.cli.options import Actor, AsJson, LeagueName, Reason, Timeout, acting, open_registry
from policy_league.cli.output import emit, say, table

if TYPE_CHECKING:
    from league.registry.registry import Registry
    from league.registry.storage.rows import Portion, ShadowCounts, Traffic
    from league.registry.traffic import Unchanged

CANARY_SHARE, SHADOW_SHARE = 0.05, 1.0
NONE = "none"


def traffic(
    league: LeagueName,
    canary: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Version that serves a share of the champion's requests; `none` removes it."),
    ] = None,
    share: Annotated[
        float | None,
        typer.Option(min=0, max=1, help=f"Share of routing keys that the canary serves. Default: {CANARY_SHARE}."),
    ] = None,
    shadow: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Version that receives copies of requests for comparison; `none` removes it."),
    ] = None,
    shadow_share: Annotated[
        float | None,
        typer.Option(min=0, max=1, help=f"Share of requests copied to the shadow. Default: {SHADOW_SHARE:g}."),
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="Remove both.")] = False,
    reason: Reason = "set by hand",
    actor: Actor = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait until every registered replica has applied the change.")
    ] = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Show or set the canary and the shadow of a league.

    A *canary* serves the requests whose routing key (header `x-league-key`: a player, an episode) falls into its share.
    Increasing the share only adds keys. A *shadow* receives copies of requests after the champion has responded; its
    actions are compared and counted but never returned. REF is a version or an alias such as `connect_four@candidate`;
    replicas follow the alias.
    """
    registry = open_registry()
    check_slug("league", league)
    options = (canary, share, shadow, shadow_share)
    if off and any(option is not None for option in options):
        raise InvalidInput("--off removes canary and shadow and cannot be combined with their options")
    if not off and all(option is None for option in options):
        _show(registry, league, as_json)
        return
    current = registry.traffic.current(league)
    setting = registry.traffic.set(
        league,
        canary=None if off else _portion(league, "--canary", canary, share, current.canary, CANARY_SHARE),
        shadow=None if off else _portion(league, "--shadow", shadow, shadow_share, current.shadow, SHADOW_SHARE),
        actor=acting(actor),
        reason=reason,
    )
    replicas = registry.changes.wait_for_traffic(setting, timeout) if wait else None
    if as_json:
        emit(asdict(setting) | ({} if replicas is None else {"replicas": replicas}))
        return
    _say(setting)
    if replicas is not None:
        say(f"All {len(replicas)} replicas have applied the change.")


def _portion(
    league: str, option: str, ref: str | None, share: float | None, now: "Portion | None", default: float
) -> "Portion | Unchanged | None":
    from league.registry.storage.rows import Portion
    from league.registry.traffic import KEEP

    if ref is None and share is None:
        return KEEP
    if ref == NONE:
        return None
    if ref is not None:
        return Portion(_version(league, option, ref), default if share is None else share)
    if now is None or share is None:
        raise InvalidInput(f"a share requires a version: {option} REF")
    return Portion(now.version, share)


def _version(league: str, option: str, ref: str) -> int | str:
    if "@" not in ref:
        return parse_version(ref)
    parsed = CheckpointRef.parse(ref)
    if parsed.league != league:
        raise InvalidInput(f"{option} {ref}: expected a version of league {league}")
    return parsed.version


def _show(registry: "Registry", league: str, as_json: bool) -> None:
    setting, shadowings = registry.traffic.current(league), registry.traffic.shadow_counts(league)
    if as_json:
        emit(asdict(setting) | {"shadows": [_document(one) for one in shadowings]})
        return
    _say(setting)
    if shadowings:
        say()
        table(
            ("shadow", "champion", "requests", "observed", "agreed", "p50 ms", "p95 ms", "failed", "dropped"),
            [
                (
                    one.candidate,
                    one.champion,
                    one.requests,
                    one.observations,
                    one.agreement,
                    one.milliseconds(0.5),
                    one.milliseconds(0.95),
                    one.failed,
                    one.dropped,
                )
                for one in shadowings
            ],
        )


def _document(one: "ShadowCounts") -> dict[str, Any]:
    from league.registry.traffic import COUNTERS

    document = {name: getattr(one, name) for name in ("candidate", "champion", *COUNTERS)}
    quantiles = {"p50": one.milliseconds(0.5), "p95": one.milliseconds(0.95)}
    return document | {"agreement": one.agreement, "latency_ms": quantiles}


def _say(setting: "Traffic") -> None:
    league = setting.league
    if setting.canary is None and setting.shadow is None:
        say(f"{league} has no canary and no shadow: the champion serves all requests.")
    if setting.canary is not None:
        say(f"{league}@{setting.canary.version} is the canary for {setting.canary.share:.1%} of the routing keys.")
    if setting.shadow is not None:
        say(f"{league}@{setting.shadow.version} is the shadow for {setting.shadow.share:.1%} of the requests.")
