"""Imported by workers of a local Ray while they wait for the trial or a runner.

Importing PyTorch and RLlib takes seconds. This way the workers and the driver do it at the same time.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # Ray sets it with the first task, which is too late for PyTorch

import training.runs.trial  # noqa: F401
from training.rllib_compat import silence_tune

silence_tune()
