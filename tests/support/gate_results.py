"""Results of tests in a gate, without games."""

from evaluation.gating.gate import Decision
from evaluation.gating.gate_result import CriterionResult


def decided(
    decision: Decision, passed: str = "beat the champion", failed: str = "is weaker", scores: str | None = None
) -> CriterionResult:
    """The result of a test with this decision, in these words."""
    return CriterionResult(
        decision=decision,
        report=None,
        passed=passed,
        failed=failed,
        scores=scores,
        requirement="To pass, it must do better.",
        wider="a larger margin",
    )
