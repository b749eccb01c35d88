"""A replica starts fast because of what it does not import."""

import subprocess
import sys

IMPORTS = """
import sys
import serve_app.app, serve_app.middleware
heavy = {name.partition(".")[0] for name in sys.modules} & {"torch", "pettingzoo", "supersuit", "mpe2", "tensorflow"}
heavy |= {name for name in sys.modules if name.startswith(("ray.rllib", "league.environments"))}
print(*sorted(heavy))
"""


def test_a_replica_needs_neither_torch_nor_an_environment() -> None:
    done = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
