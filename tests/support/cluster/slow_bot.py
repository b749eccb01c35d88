"""A bot that plays at random, and slowly while a file exists, so that a tournament lasts as long as a test needs."""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

PAUSE = 0.25
"""Seconds of a batch of actions."""
FILE = "SLOW_BOT_FILE"
"""The environment variable that names the file."""


def act(observation: Any, action_mask: Any, rng: Any) -> list[int]:
    """Choose among the legal actions of each row."""
    if Path(os.environ.get(FILE, "/nonexistent")).exists():
        time.sleep(PAUSE)
    return [int(generator.choice(np.flatnonzero(mask))) for generator, mask in zip(rng, action_mask, strict=True)]


act.batched = True  # type: ignore[attr-defined]
