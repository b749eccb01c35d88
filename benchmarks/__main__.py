"""`make bench`: run the benchmarks named in BENCH, or all; options such as `--quick` are passed on to them."""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ORDER = (
    "stepping",
    "equality",
    "spaces",
    "sampling",
    "replay",
    "phases",
    "gpu",
    "learning",
    "maddpg",
    "league_training",
    "training_nights",
    "exploiters",
    "exploitability",
    "parity",
    "imports",
    "serving",
    "perf_analyzer",
    "pages",
    "formats",
    "promotions",
    "shadowing",
    "autoscaling",
    "footprint",
    "object_store",
    "registry_scale",
    "streams",
    "faults",
    "fuzz",
    "hostile",
    "attacks",
    "fresh_machine",
    "strength",
    "decisive_positions",
    "calibration",
    "evaluation",
    "crowded_league",
    "cluster",
    "startup",
)


def main() -> int:
    """Run each benchmark in a subprocess, so that each has its own Ray; 1 if any failed."""
    names = [argument for argument in sys.argv[1:] if not argument.startswith("-")]
    options = [argument for argument in sys.argv[1:] if argument.startswith("-")]
    unknown = [name for name in names if name not in ORDER]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}: expected some of {', '.join(ORDER)}", file=sys.stderr)
        return 2
    failed = []
    for name in names or ORDER:
        print(f"\n== {name} ==", flush=True)
        if subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *options], cwd=HERE.parent).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
