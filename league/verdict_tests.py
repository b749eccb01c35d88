"""The tests of a verdict after that against the champion, as they are recorded in its settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

AnchorMode = Literal["no_worse", "at_least"]
"""What a test against an anchor compares the candidate with: the champion's results against it, or the anchor."""


@dataclass(frozen=True, slots=True)
class AnchorTest:
    """Whether the candidate is not inferior to an anchor, or to the champion against the anchor.

    Attributes:
        ref: The anchor.
        margin: By how much the candidate may be weaker, or do worse than the champion.
        schedule: Id of the schedule of its matches.
        mode: What the candidate is compared with.
    """

    ref: str
    margin: float
    schedule: str
    mode: AnchorMode = "at_least"


@dataclass(frozen=True, slots=True)
class ExploiterTest:
    """Whether the candidate does not do worse than the champion against an exploiter.

    Attributes:
        ref: The exploiter.
        exploits: The champion that it was trained against.
        margin: By how much the candidate may be worse than the champion.
        schedule: Id of the schedule of its matches.
    """

    ref: str
    exploits: str
    margin: float
    schedule: str


@dataclass(frozen=True, slots=True)
class ExploitabilityTest:
    """Whether the candidate is not more exploitable than the champion, by exploiters trained against each.

    Attributes:
        of_candidate: Exploiters of the candidate.
        of_champion: As many exploiters of the champion.
        margin: By how much the candidate may be more exploitable.
        blocks: Rounds to be played at least, from which exploitability is estimated.
        schedule: Id of the schedule of its matches.
        improvement: By how much the candidate must be less exploitable; 0 if it need not be.
    """

    of_candidate: tuple[str, ...]
    of_champion: tuple[str, ...]
    margin: float
    blocks: int
    schedule: str
    improvement: float = 0.0

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> ExploitabilityTest:
        """Read the test from its record in the settings of a verdict."""
        return cls(
            of_candidate=tuple(record["of_candidate"]),
            of_champion=tuple(record["of_champion"]),
            margin=record["margin"],
            blocks=record["blocks"],
            schedule=record["schedule"],
            improvement=record["improvement"],
        )

    def to_record(self) -> dict[str, Any]:
        """Return the record, in the types of JSON. The inverse of `of_record`."""
        return asdict(self) | {"of_candidate": list(self.of_candidate), "of_champion": list(self.of_champion)}


CompanionTest = AnchorTest | ExploiterTest | ExploitabilityTest


@dataclass(frozen=True, slots=True)
class CompanionTests:
    """The tests that a candidate must pass besides that against the champion.

    Attributes:
        anchors: In the order in which they are played, before the exploiters.
        exploiters: In the order in which they are played.
        exploitability: The last test; None if the verdict has none, or while its exploiters are not trained.
        awaits_exploiters: Whether the verdict has a test of exploitability whose exploiters are not trained.
        confirmation: Id of the schedule of the confirmation match, which has no influence on the decision.
    """

    anchors: tuple[AnchorTest, ...] = ()
    exploiters: tuple[ExploiterTest, ...] = ()
    exploitability: ExploitabilityTest | None = None
    awaits_exploiters: bool = False
    confirmation: str | None = None

    @classmethod
    def of_settings(cls, settings: Mapping[str, Any]) -> CompanionTests:
        """Read the tests from the settings of a verdict. Unknown settings, of other releases, are ignored."""
        anchors, exploiters = settings.get("anchors", ()), settings.get("exploiters", ())
        trained = settings.get("exploitability")
        return cls(
            anchors=tuple(
                AnchorTest(anchor["ref"], anchor["margin"], anchor["schedule"], anchor["mode"]) for anchor in anchors
            ),
            exploiters=tuple(
                ExploiterTest(exploiter["ref"], exploiter["exploits"], exploiter["margin"], exploiter["schedule"])
                for exploiter in exploiters
            ),
            exploitability=None if trained is None else ExploitabilityTest.of_record(trained),
            awaits_exploiters="exploitability" in settings and trained is None,
            confirmation=settings.get("confirmation"),
        )

    def to_settings(self) -> dict[str, Any]:
        """Return the settings in which the tests are recorded. The inverse of `of_settings`."""
        settings: dict[str, Any] = {
            "anchors": [asdict(anchor) for anchor in self.anchors],
            "exploiters": [asdict(exploiter) for exploiter in self.exploiters],
        }
        if self.exploitability is not None:
            settings["exploitability"] = self.exploitability.to_record()
        elif self.awaits_exploiters:
            settings["exploitability"] = None
        if self.confirmation is not None:
            settings["confirmation"] = self.confirmation
        return settings

    @property
    def includes_exploitability(self) -> bool:
        """Whether the verdict has a test of exploitability."""
        return self.awaits_exploiters or self.exploitability is not None

    @property
    def ready(self) -> tuple[CompanionTest, ...]:
        """The tests that have a schedule, in the order in which they are played."""
        last = () if self.exploitability is None else (self.exploitability,)
        return (*self.anchors, *self.exploiters, *last)

    @property
    def number(self) -> int:
        """Number of tests, including one whose exploiters are not trained yet."""
        return len(self.ready) + self.awaits_exploiters

    @property
    def opponents(self) -> set[str]:
        """References of all anchors and exploiters."""
        last = self.exploitability
        trained = () if last is None else (*last.of_candidate, *last.of_champion)
        return {*(anchor.ref for anchor in self.anchors), *(exploiter.ref for exploiter in self.exploiters), *trained}
