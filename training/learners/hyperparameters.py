"""What each policy learns by: the league's settings, and what is set otherwise for it."""

from dataclasses import dataclass, fields

from league.errors import ConfigError
from league.training_config import PPOConfig


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """See PPOConfig."""

    lr: float
    gamma: float
    lambda_: float
    clip: float
    entropy: float


def hyperparameters(settings: PPOConfig, policies: tuple[str, ...]) -> dict[str, Hyperparameters]:
    """Policy id → its own. Raises ConfigError where `per_policy` names one that is not among `policies`."""
    for policy in settings.per_policy:
        if policy not in policies:
            raise ConfigError(f"training.per_policy.{policy}: no such policy; the league has {', '.join(policies)}")
    return {policy: _of(settings, policy) for policy in policies}


def _of(settings: PPOConfig, policy: str) -> Hyperparameters:
    own = settings.per_policy.get(policy)
    values = {field.name: getattr(settings, field.name) for field in fields(Hyperparameters)}
    if own is not None:
        values |= own.model_dump(exclude_none=True)
    return Hyperparameters(**values)
