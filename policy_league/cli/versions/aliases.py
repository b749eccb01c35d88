"""`league promote`, `mixture`, `rollback` and `history`."""

from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from league.errors import ConfigError, InvalidInput, InvalidReference
from league.refs import (
    CHAMPION,
    CheckpointRef,
    check_alias,
    check_slug,
    is_mixture,
    parse_mixture,
    short_verdict,
)
from policy_league.cli.options import Actor, AsJson, LeagueName, Reason, Timeout, acting, open_registry
from policy_league.cli.output import confirm, counted, emit, say, table

if TYPE_CHECKING:
    from league.registry.registry import Registry
    from league.registry.storage.rows import AliasEvent, VersionRow
    from league.results.payoffs import MetaStrategy
Wait = Annotated[bool, typer.Option("--wait", help="Wait until every registered replica serves it; exit 1 on timeout.")]


def promote(
    ref: Annotated[
        str,
        typer.Argument(
            metavar="REF", help="Version, such as connect_four@3, or mixture, such as connect_four@3:0.6,@5:0.4."
        ),
    ],
    alias: Annotated[str, typer.Option("--alias", "--to", help="The alias to move.")] = CHAMPION,
    expected: Annotated[
        str | None,
        typer.Option(
            metavar="VERSION", help="Fail unless the alias currently points to this version (`none`: to no version)."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    reason: Reason = "promoted by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Make a version or a mixture the champion, or move another alias to it.

    A champion that the gate has rejected, or that has played no game under the current conditions, is confirmed in the
    terminal or with --yes.

    A mixture becomes a version of its own, which plays each episode with one of its members, drawn by the
    probabilities.

    Replicas serve the new version within a second; --wait waits for their confirmation. Without --expected, the current
    version of the alias is expected, so only one of two concurrent promotions succeeds.
    """
    registry = open_registry()
    check_alias(alias)
    expectation = None if expected is None else (_expected(expected),)
    version = _mixture(registry, ref) if is_mixture(ref) else registry.versions.resolve(CheckpointRef.parse(ref))
    for number in (version.number, *(version.mixture.versions if version.mixture else ())):
        registry.artifacts.check_exists(version.league, number)
    current = registry.aliases.current(version.league).get(alias)
    before = current if expectation is None else expectation[0]
    if alias == CHAMPION and not yes and version.number != current:
        from evaluation.reporting.gate_record import doubts

        registry.aliases.check(version.league, alias, version.number, expected=before)
        if (evidence := doubts(registry, version)) is not None:
            hint = f"{evidence}; confirm with --yes that {version.ref} shall be champion"
            question = f"Make {version.ref} the champion?"
            confirm(question, yes=False, as_json=as_json, hint=hint, reason=f"{evidence}.")
    event = registry.aliases.set(
        version.league,
        alias,
        version.number,
        expected=before,
        actor=acting(actor),
        reason=reason,
    )
    _moved(event, current, as_json, registry.changes.wait_for_alias(event, timeout) if wait else None)


def _mixture(registry: "Registry", text: str) -> "VersionRow":
    """Publish the mixture that a text describes."""
    shares: dict[int, float] = {}
    for ref, share in parse_mixture(text).items():
        number = registry.versions.resolve(ref).number
        shares[number] = shares.get(number, 0.0) + share
    return registry.publisher.publish_mixture(next(iter(parse_mixture(text))).league, shares)


def mixture(
    league: LeagueName,
    method: Annotated[
        str, typer.Option(help="`nash`: equilibrium of maximum entropy; `alpha_rank`: evolutionary share.")
    ] = "nash",
    at_least: Annotated[
        float, typer.Option(min=0, max=0.5, help="Leave out versions with a lower probability, and rescale the rest.")
    ] = 0.01,
    alias: Annotated[
        str | None, typer.Option("--alias", "--to", help="The alias to move to the mixture. Default: only show it.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    reason: Reason = "equilibrium of the league",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Point an alias to the equilibrium of a league, or show it.

    The equilibrium is a mixture of the versions of the current environment. It is computed from the payoff matrix, the
    mean scores of the recorded games between them, and shown before the alias moves.
    """
    from league.policies.loading import eligible
    from league.results.ledger import Ledger
    from league.results.payoffs import METHODS, meta_strategy
    from league.results.sums import outcomes, whole

    if method not in METHODS:
        raise InvalidInput(f"--method {method!r}: expected {' or '.join(METHODS)}")
    if alias is not None:
        check_alias(alias)
    registry = open_registry()
    conditions = registry.leagues.get(check_slug("league", league)).conditions
    refs = [row.ref for row in eligible(registry, league) if row.search is None]
    ledger = Ledger(registry)
    sums = ledger.sums(league, ledger.counted(league, conditions))
    equilibrium = meta_strategy(refs, outcomes(whole(sums)), method)
    probabilities = zip(equilibrium.refs, equilibrium.probabilities, strict=True)
    kept = {ref: share for ref, share in probabilities if share > 0 and share >= at_least}
    if not kept:
        highest = max(equilibrium.probabilities, default=0.0)
        raise InvalidInput(
            f"--at-least {at_least:g}: no version is as probable; the highest probability is {highest:.3f}"
        )
    shares = {ref: share / sum(kept.values()) for ref, share in kept.items()}
    if not as_json:
        _show(equilibrium, shares)
    if alias is None:
        if as_json:
            figures = {"games": equilibrium.games, "unmet": equilibrium.unmet}
            emit({"league": league, "method": method} | figures | {"members": shares})
        return
    hint = "without a terminal, confirm with --yes, or omit --alias to show the mixture only"
    confirm(f"Point {league}@{alias} to it?", yes=yes, as_json=as_json, hint=hint)
    ref = next(iter(shares)) if len(shares) == 1 else ",".join(f"{ref}:{share!r}" for ref, share in shares.items())
    promote(ref, alias=alias, yes=True, reason=reason, actor=actor, wait=wait, timeout=timeout, as_json=as_json)


def _show(found: "MetaStrategy", shares: dict[str, float]) -> None:
    """Print the mixture `shares`, and the scores against it."""
    table(
        ("version", "probability", "score against it"),
        [
            (ref, shares.get(ref, 0.0), score)
            for ref, _, score in sorted(
                zip(found.refs, found.probabilities, found.scores(shares), strict=True), key=lambda row: -row[1]
            )
        ],
    )
    unmet = f" {found.unmet} pairs have not met and count as equally strong." if found.unmet else ""
    say(f"Computed from {found.games:g} games.{unmet}")


def _expected(text: str) -> int | None:
    if text == "none":
        return None
    if not text.isdigit():
        raise InvalidReference(f"--expected {text!r}: expected a version number or `none`")
    return int(text)


def rollback(
    league: LeagueName,
    expected: Annotated[
        int | None, typer.Option(metavar="VERSION", min=1, help="Fail unless this version is the champion.")
    ] = None,
    reason: Reason = "rolled back by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Restore the previous champion.

    Moves the alias `champion` to the version that it pointed to before, and records the move in the history. With
    --expected, only one of several rollbacks of the same version succeeds.
    """
    from league.registry.aliases import ANY

    registry = open_registry()
    event = registry.aliases.rollback(
        check_slug("league", league),
        expected=ANY if expected is None else expected,
        actor=acting(actor),
        reason=reason,
    )
    _moved(event, event.previous, as_json, registry.changes.wait_for_alias(event, timeout) if wait else None)


def _moved(event: "AliasEvent", previous: int | None, as_json: bool, replicas: list[str] | None) -> None:
    """Print the move of an alias, and the replicas that have confirmed it.

    previous: the version that it pointed to until now. If it is that of the event, the event is an earlier one.
    """
    if as_json:
        emit(_document(event) | ({} if replicas is None else {"replicas": replicas}))
        return
    if previous == event.version:
        say(f"{event.league}@{event.alias} already points to version {event.version}.")
    else:
        before = "nothing" if previous is None else f"version {previous}"
        say(f"{event.league}@{event.alias} now points to version {event.version} (before: {before}).")
    if replicas is not None:
        say(f"Confirmed by {counted(len(replicas), 'replica')}.")


def history(
    league: LeagueName,
    alias: Annotated[str, typer.Option(help="Name of the alias.")] = CHAMPION,
    at: Annotated[
        str | None, typer.Option(help="Show only the entry in effect at this time, such as '2026-03-03 14:00'.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show when and why an alias moved, and who moved it."""
    from league.registry.storage.manifest import Mixture

    try:
        when = None if at is None else datetime.fromisoformat(at).astimezone(UTC)  # local time, unless it says another
    except ValueError as error:
        raise ConfigError(f"--at {at!r}: expected a time such as '2026-03-03 14:00'") from error
    registry = open_registry()
    events = registry.aliases.history(check_slug("league", league), check_alias(alias), when)
    mixtures = {
        number: one
        for number, one in registry.versions.compositions(league, {event.version for event in events}).items()
        if isinstance(one, Mixture)
    }
    if as_json:
        members = {number: [member.model_dump() for member in one.members] for number, one in mixtures.items()}
        documents = [_document(event) | {"members": members.get(event.version)} for event in events]
        emit({"league": league, "alias": alias, "events": documents})
        return
    if not events:
        say(f"{league}@{alias} has no history{'' if at is None else ' at that time'}.")
        return
    table(
        ("time", "version", "before", "actor", "reason", "verdict"),
        [
            (
                event.at,
                event.version if event.version not in mixtures else f"{event.version} ({mixtures[event.version]})",
                event.previous,
                event.actor,
                event.reason,
                event.verdict and short_verdict(event.verdict),
            )
            for event in events
        ],
        prose=("reason",),
    )


def _document(event: "AliasEvent") -> dict[str, object]:
    return {name: value for name, value in asdict(event).items() if name != "beneath"}
