"""A replica starts quickly because it does not import large packages."""

import subprocess
import sys

IMPORTS = """
import sys
import serve_app.app, serve_app.runtime.serve_bypass
heavy = {name.partition(".")[0] for name in sys.modules} & {"torch", "pettingzoo", "supersuit", "mpe2", "tensorflow"}
heavy |= {name for name in sys.modules if name.startswith(("ray.rllib", "league.environments"))}
print(*sorted(heavy))
"""


def test_a_replica_imports_neither_torch_nor_environments() -> None:
    process = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True)
    assert process.stdout.split() == []
