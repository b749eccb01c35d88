"""Results of `benchmarks.scale` are read from its folder, and have limits only on the machine that these are for."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from benchmarks import scale
from benchmarks.harness import Target
from benchmarks.scale import Machine, Result, Trained

PLACE = Machine([*range(16)], "NVIDIA H200", 1.0)
RATES = {"as shipped": 250_000, "convolutions": 300_000, "MLP": 2_000_000}
GPU = Result("gpu", "0123456789", "Xeon, 1.72 s", PLACE, "…", {n: Trained(r, {}, {}) for n, r in RATES.items()}, {})


def targets(folder: Path, *results: Result) -> list[Target]:
    (folder / scale.RESULTS).write_text("".join(f"{json.dumps(asdict(result))}\n" for result in results))
    return list(scale.main([result.part for result in results], folder=folder))


def test_results_are_read_from_the_folder(tmp_path: Path) -> None:
    off_policy = {"simple_spread_qmix, threads: 1": 10.0, "simple_spread_qmix, threads: 2": 12.0}
    off_policy |= {"simple_spread_qmix, GPU": 6.0, "simple_adversary, threads: 1": 5.0, "simple_adversary, GPU": 10.0}
    values = targets(tmp_path, GPU, replace(GPU, part="off_policy", trained={}, rates=off_policy))
    assert [(target.value, target.met) for target in values] == [
        *((250_000, True), (300_000, False), (2_000_000, True)),
        *((2.0, False), (0.5, True)),
    ]
    assert {target.machine for target in values} == {"Xeon, 1.72 s, 16 cores, NVIDIA H200, 0123456"}
    assert values[3].peer == "threads: 2"


@pytest.mark.parametrize("place", [replace(PLACE, gpu=""), replace(PLACE, cores=[0, 1]), replace(PLACE, scale=0.1)])
def test_other_machines_and_quick_runs_have_no_limits(tmp_path: Path, place: Machine) -> None:
    assert {target.limit for target in targets(tmp_path, replace(GPU, place=place))} == {""}


@pytest.mark.slow
def test_a_part_trains_and_plays(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert list(scale.main(["strength"], quick=True, folder=tmp_path, train_only=True)) == []
    assert {path.name for path in tmp_path.iterdir()} == {scale.RESULTS, "strength-1.onnx"}
    values = list(scale.main(["strength"], quick=True, folder=tmp_path))
    assert len(values) == 2
    assert capfd.readouterr().out.count("Published") == 1, "it is trained once"
