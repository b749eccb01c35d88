import io

from rich.console import Console

from league.config import PPOConfig
from training.progress import Progress

SETTINGS = PPOConfig(steps=1000, minutes=2)
METRICS = {"steps": 250, "seconds": 60.0, "steps_per_second": 12.5, "a/return": 0.5, "a/length": 7.0, "a/entropy": 1.25}


def shown(*updates: dict[str, object], terminal: bool = False) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=120)
    with Progress(console, SETTINGS, ("a", "b")) as progress:
        for metrics in updates:
            progress.update(metrics)
    return file.getvalue()


def test_a_line_says_how_far_the_budget_is_spent_and_how_each_policy_does() -> None:
    """A quarter of the steps, but half of the time: the time decides."""
    (line,) = shown(METRICS).splitlines()
    assert "50%  250 steps" in line
    assert "1:00 trained, 1:00 to go" in line
    assert "a: return +0.50, length 7.0, entropy 1.25; b: no episode is over yet" in line


def test_a_log_gets_few_lines_but_always_the_last() -> None:
    lines = shown(METRICS, METRICS, METRICS | {"steps": 1000, "done": True}).splitlines()
    assert len(lines) == 2
    assert "100%  1,000 steps" in lines[-1]


def test_a_terminal_is_kept_up_to_date() -> None:
    assert "250 steps" in shown(METRICS, terminal=True)
