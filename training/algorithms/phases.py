"""Which policies learn at which update."""

from collections.abc import Sequence

from league.errors import ConfigError
from league.training_config import PhaseConfig, PPOConfig, TrainingSettings


def learning(settings: TrainingSettings, policies: tuple[str, ...], iteration: int) -> tuple[str, ...]:
    """The policies that learn at the update after `iteration` others; phases follow one another in a circle."""
    planned = settings.policies_to_train
    if planned is None:
        return policies
    phases = [phase for phase in planned if isinstance(phase, PhaseConfig)]
    if not phases:
        return tuple(policy for policy in policies if policy in planned)
    place = iteration % sum(phase.iterations for phase in phases)
    for phase in phases:
        if place < phase.iterations:
            return tuple(policy for policy in policies if policy in phase.policies)
        place -= phase.iterations
    raise AssertionError("a place in the circle lies in one of its phases")


def check(settings: TrainingSettings, policies: tuple[str, ...]) -> None:
    """Raise ConfigError where `policies_to_train` names a policy that the league does not have, or lets some rest
    whose encoder the others go on changing."""
    planned = settings.policies_to_train
    if planned is None:
        return
    shared_encoder = isinstance(settings, PPOConfig) and settings.shared_encoder
    for part in planned:
        named: Sequence[str] = part.policies if isinstance(part, PhaseConfig) else (part,)
        for policy in named:
            if policy not in policies:
                known = ", ".join(policies)
                raise ConfigError(f"training.policies_to_train: no policy {policy!r}; the league has {known}")
        if shared_encoder and isinstance(part, PhaseConfig) and set(named) != set(policies):
            raise _changed_at_rest()
    if shared_encoder and not isinstance(planned[0], PhaseConfig) and set(planned) != set(policies):
        raise _changed_at_rest()


def _changed_at_rest() -> ConfigError:
    return ConfigError(
        "training.policies_to_train: with shared_encoder all policies learn together: one that rests would change with"
        " the encoder"
    )
