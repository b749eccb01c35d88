import io

from rich.console import Console

from league.training_config import PPOConfig
from training.progress import Progress, clock

SETTINGS = PPOConfig(steps=1000, minutes=2)
METRICS = {"steps": 250, "seconds": 60.0, "steps_per_second": 12.5, "a/return": 0.5, "a/length": 7.0, "a/entropy": 1.25}


def shown(*updates: dict[str, object], terminal: bool = False, policies: tuple[str, ...] = ("a", "b")) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=200)
    with Progress(console, SETTINGS, policies) as progress:
        for metrics in updates:
            progress.update(metrics)
    return file.getvalue()


def test_a_line_says_how_far_the_budget_is_spent_and_how_each_policy_does() -> None:
    """A quarter of the steps, but half of the time: the time decides."""
    (line,) = shown(METRICS).splitlines()
    assert "50%  250 steps" in line
    assert "12 steps/s  1:00 trained, 1:00 to go" in line
    assert "a: return +0.50, length 7.0, entropy 1.25; b: no episode is over yet" in line


def test_a_log_gets_few_lines_but_always_the_last() -> None:
    lines = shown(METRICS, METRICS, METRICS | {"steps": 1000, "done": True}).splitlines()
    assert len(lines) == 2
    assert "100%  1,000 steps" in lines[-1]


def test_many_policies_do_not_flood_it() -> None:
    (line,) = shown(METRICS, policies=("a", "b", "c", "d", "e")).splitlines()
    assert line.endswith("c: no episode is over yet; 2 more")


def test_a_terminal_has_a_bar_that_is_kept_up_to_date() -> None:
    drawn = shown(METRICS, METRICS | {"steps": 750}, terminal=True)
    for part in ("━", "75%", "750 steps", "12 steps/s", "0:20 to go", "return +0.50"):
        assert part in drawn


def test_a_report_without_an_update_has_no_speed() -> None:
    """As when training is asked to end before it begins."""
    (line,) = shown({"steps": 0, "seconds": 0.0, "done": True}).splitlines()
    assert "0%  0 steps" in line
    assert "steps/s" not in line


def test_a_clock() -> None:
    assert [clock(seconds) for seconds in (0, 61.9, 3600, 36_061)] == ["0:00", "1:01", "1:00:00", "10:01:01"]
