"""What all benchmarks share: their targets, how results are printed and recorded, and rates measured in alternation."""

import json
import platform
import re
import statistics
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Annotated, TypeVar

import typer

ROOT = Path(__file__).parent.parent
CONFIGS = ROOT / "policy_league/configs"
RESULTS = Path(__file__).parent / "results"
ADDITIONS = 20_000_000
"""Additions in a Python loop, whose time tells how fast a virtual machine is at the moment."""

Quick = Annotated[bool, typer.Option("--quick", help="a smoke test: shorter, and with fewer repetitions")]
"""The option that every benchmark has."""

Parts = Annotated[list[str] | None, typer.Argument(metavar="[PART]...", help="all by default")]
"""The argument of benchmarks that consist of parts."""

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Target:
    """A measured value, and what it should be.

    value: one number, or several of the same kind, such as one for each seed. at_least, at_most: limits of each number;
    None: the value is only reported. peer: what it was compared with in the same run. machine: where it was measured;
    empty for the machine that records it.
    """

    name: str
    value: float | tuple[float, ...]
    unit: str = ""
    at_least: float | None = None
    at_most: float | None = None
    peer: str = ""
    note: str = ""
    machine: str = ""

    @property
    def met(self) -> bool:
        """Whether all numbers are within the limits. NaN is not."""
        numbers = self.value if isinstance(self.value, tuple) else (self.value,)
        return all(
            (self.at_least is None or number >= self.at_least) and (self.at_most is None or number <= self.at_most)
            for number in numbers
        )

    @property
    def measured(self) -> str:
        """The value with its unit, such as `1.07×`."""
        numbers = self.value if isinstance(self.value, tuple) else (self.value,)
        return f"{', '.join(map(_number, numbers))}{_unit(self.unit)}"

    @property
    def limit(self) -> str:
        """What the value should be, such as `≥0.97×`; empty if nothing is required."""
        limits = (("≥", self.at_least), ("≤", self.at_most))
        return ", ".join(f"{sign}{_number(limit)}{_unit(self.unit)}" for sign, limit in limits if limit is not None)

    def __str__(self) -> str:
        against = f" against {self.peer}" if self.peer else ""
        target = f"   (target {self.limit}{'' if self.met else ': MISSED'})" if self.limit else ""
        note = f" ({self.note})" if self.note else ""
        return f"{self.name}{against}: {self.measured}{note}{target}"


def _number(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) else f"{number:,.{4 if abs(number) < 1 else 6}g}"


def _unit(unit: str) -> str:
    return unit if unit in ("", "×") or unit.startswith("/") else f" {unit}"


def chosen(parts: Sequence[str] | None, of: Mapping[str, Value]) -> dict[str, Value]:
    """The named parts of a benchmark; without names, all of them. Raises typer.BadParameter on an unknown name."""
    if unknown := [part for part in parts or () if part not in of]:
        raise typer.BadParameter(f"no part {', '.join(unknown)}: expected some of {', '.join(of)}")
    return {part: of[part] for part in parts or of}


@dataclass(frozen=True, slots=True)
class Run:
    """The results of one run. machine: processor and speed. options: those of the command line."""

    date: str
    machine: str
    options: str
    targets: tuple[Target, ...]


def machine() -> str:
    """The processor, and the seconds that it needs for 20 million additions in a Python loop."""
    cpu_info = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.+)", cpu_info.read_text()) if cpu_info.exists() else None
    return f"{model[1] if model else platform.processor()}, {additions():.2f} s"


def additions() -> float:
    """The seconds that the processor needs for 20 million additions in a Python loop."""
    total, began = 0, time.process_time()
    for number in range(ADDITIONS):
        total += number
    return time.process_time() - began


def recorded(benchmark: str) -> list[Run]:
    """The recorded runs of a benchmark, the oldest first."""
    path = RESULTS / f"{benchmark}.json"
    documents = json.loads(path.read_text()) if path.exists() else []
    return [Run(**document | {"targets": tuple(map(_target, document["targets"]))}) for document in documents]


def _target(document: dict[str, object]) -> Target:
    value = document["value"]
    return Target(**document | {"value": tuple(value) if isinstance(value, list) else value})  # type: ignore[arg-type]


def record(benchmark: str, options: str, targets: Iterable[Target]) -> None:
    """Add a run of today to the results of a benchmark, or one for each machine of the targets."""
    today, runs = datetime.now(UTC).date().isoformat(), recorded(benchmark)
    for place, group in groupby(targets, key=lambda target: target.machine):
        runs.append(Run(today, place or machine(), options, tuple(replace(target, machine="") for target in group)))
    write(benchmark, runs)


def write(benchmark: str, runs: Iterable[Run]) -> None:
    """Write the results of a benchmark, each value on a line."""
    texts = []
    for run in runs:
        head = {"date": run.date, "machine": run.machine, "options": run.options}
        lines = ",\n".join(f"   {_json(_without_defaults(target))}" for target in run.targets)
        texts.append(f'  {_json(head)[:-1]}, "targets": [\n{lines}]}}')
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{benchmark}.json").write_text("[\n" + ",\n".join(texts) + "\n]\n")


def _without_defaults(target: Target) -> dict[str, object]:
    return {name: value for name, value in asdict(target).items() if value not in ("", None)}


def _json(document: object) -> str:
    return json.dumps(document, ensure_ascii=False)


def in_rounds(measures: Mapping[Key, Callable[[], float]], rounds: int) -> dict[Key, float]:
    """The median of each measurement over the rounds, in which all of them alternate."""
    values: dict[Key, list[float]] = {key: [] for key in measures}
    for _ in range(rounds):
        for key, measure in measures.items():
            values[key].append(measure())
    return {key: statistics.median(numbers) for key, numbers in values.items()}


def rate(step: Callable[[], float], seconds: float, clock: Callable[[], float] = time.perf_counter) -> float:
    """How much a function returns per second, repeated for some seconds."""
    total, began = 0.0, clock()
    while (elapsed := clock() - began) < seconds:
        total += step()
    return total / elapsed
