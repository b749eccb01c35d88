"""`league traffic`: the canary and the shadow of a league."""

import getpass
from dataclasses import asdict
from typing import Annotated, Any

import typer

from cli.output import emit, say, table
from cli.versions import Actor, AsJson, LeagueName, Reason, Timeout
from league.errors import InvalidInput
from league.refs import CheckpointRef, check_slug, parse_version
from league.registry.following import await_traffic
from league.registry.registry import Registry
from league.registry.rows import Portion, Shadowing, Traffic
from league.registry.traffic import KEEP, Unchanged

CANARY_SHARE, SHADOW_SHARE = 0.05, 1.0
NOBODY = "none"


def traffic(
    league: LeagueName,
    canary: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Answers a share of the champion's requests; `none` ends that."),
    ] = None,
    share: Annotated[
        float | None, typer.Option(min=0, max=1, help=f"Share of keys that it answers. Default: {CANARY_SHARE}.")
    ] = None,
    shadow: Annotated[
        str | None,
        typer.Option(metavar="REF", help="Is shown the champion's requests and compared; `none` ends that."),
    ] = None,
    shadow_share: Annotated[
        float | None, typer.Option(min=0, max=1, help=f"Share of requests that it is shown. Default: {SHADOW_SHARE:g}.")
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="End both.")] = False,
    reason: Reason = "set by hand",
    actor: Actor = None,
    wait: Annotated[bool, typer.Option("--wait", help="Return when every live replica follows.")] = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Show or set which versions get a share of a league's requests besides the champion.

    A *canary* answers callers whose key (header `x-league-key`: a player, an episode) falls into its share; a greater
    share only adds keys. A *shadow* is shown requests after the champion has answered; its answers are compared and
    counted, and nobody sees them. REF is a version or an alias, which is then followed: `connect_four@candidate`.
    """
    registry = Registry.open()
    check_slug("league", league)
    given = (canary, share, shadow, shadow_share)
    if off and any(option is not None for option in given):
        raise InvalidInput("--off ends both canary and shadow: it goes with no other of them")
    if not off and all(option is None for option in given):
        _show(registry, league, as_json)
        return
    now = registry.traffic(league)
    setting = registry.set_traffic(
        league,
        canary=None if off else _portion(league, "--canary", canary, share, now.canary, CANARY_SHARE),
        shadow=None if off else _portion(league, "--shadow", shadow, shadow_share, now.shadow, SHADOW_SHARE),
        actor=actor or getpass.getuser(),
        reason=reason,
    )
    replicas = await_traffic(registry, setting, timeout) if wait else None
    if as_json:
        emit(asdict(setting) | ({} if replicas is None else {"replicas": replicas}))
        return
    _say(setting)
    if replicas is not None:
        say(f"All {len(replicas)} replicas follow.")


def _portion(
    league: str, option: str, ref: str | None, share: float | None, now: Portion | None, default: float
) -> Portion | Unchanged | None:
    if ref is None and share is None:
        return KEEP
    if ref == NOBODY:
        return None
    if ref is not None:
        return Portion(_version(league, option, ref), default if share is None else share)
    if now is None or share is None:
        raise InvalidInput(f"a share needs a version: {option} REF")
    return Portion(now.version, share)


def _version(league: str, option: str, ref: str) -> int | str:
    if "@" not in ref:
        return parse_version(ref)
    parsed = CheckpointRef.parse(ref)
    if parsed.league != league:
        raise InvalidInput(f"{option} {ref}: expected a version of league {league}")
    return parsed.version


def _show(registry: Registry, league: str, as_json: bool) -> None:
    setting, shadowings = registry.traffic(league), registry.shadowings(league)
    if as_json:
        emit(asdict(setting) | {"shadows": [_document(one) for one in shadowings]})
        return
    _say(setting)
    if shadowings:
        say()
        table(
            ("candidate", "champion", "requests", "observations", "agreement", "p50 ms", "p95 ms", "failed", "dropped"),
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


def _document(one: Shadowing) -> dict[str, Any]:
    document = asdict(one)
    del document["latency"], document["ns"], document["league"]
    quantiles = {"p50": one.milliseconds(0.5), "p95": one.milliseconds(0.95)}
    return document | {"agreement": one.agreement, "latency_ms": quantiles}


def _say(setting: Traffic) -> None:
    league = setting.league
    if setting.canary is None and setting.shadow is None:
        say(f"All requests for {league} are answered by its champion alone.")
    if setting.canary is not None:
        say(f"{league}@{setting.canary.version} answers {setting.canary.share:.1%} of the keys, as canary.")
    if setting.shadow is not None:
        say(f"{league}@{setting.shadow.version} is shown {setting.shadow.share:.1%} of the requests, as shadow.")
