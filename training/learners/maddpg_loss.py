"""Target and losses of MADDPG: Lowe et al., 2017, "Multi-agent actor-critic for mixed cooperative-competitive
environments", arXiv 1706.02275, equations 5 and 6. With a critic of the agent's own observation and action alone they
are those of DDPG: Lillicrap et al., 2016, arXiv 1509.02971, equations 5 and 6.
"""

from torch import Tensor


def td_target(rewards: Tensor, next_values: Tensor, terminated: Tensor, discounts: Tensor) -> Tensor:
    """y = r + γ Q'(x', a'_1 … a'_N), a'_k = μ'_k(o'_k), and r alone where the agent has terminated: one that was
    truncated could have gone on.

    All (B,): next_values Q', terminated bool, discounts γ, or γⁿ of rewards that are summed over n steps.
    """
    assert rewards.shape == next_values.shape == terminated.shape == discounts.shape
    return rewards + discounts * next_values * (~terminated).float()


def critic_loss(values: Tensor, targets: Tensor, weights: Tensor | None = None) -> Tensor:
    """mean((Q(x, a_1 … a_N) − y)²), equation 6. weights: (B,) by which rows count."""
    assert values.shape == targets.shape
    errors = (values - targets).square()
    return (errors if weights is None else weights * errors).mean()


def actor_loss(values: Tensor, answers: Tensor, regularization: float, weights: Tensor | None = None) -> Tensor:
    """−mean(Q(x, a_1 … μ_i(o_i) … a_N)) + λ mean(answers²), whose gradient is that of equation 5.

    values: (B,), differentiable in the agent's own action alone. answers: (B, d), what its actor answers before masks
    and bounds; the second term keeps them small, as the authors' implementation does (openai/maddpg, λ = 0.001).
    weights: (B,) by which rows count.
    """
    value = values if weights is None else weights * values
    return regularization * answers.square().mean() - value.mean()
