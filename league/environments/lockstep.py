"""Environment configuration → n copies behind the batched stepping protocol, whatever their API."""

from league.config import EnvironmentConfig
from league.environments.aec import AECStepping
from league.environments.stepping import BatchedEnvironment


def stepping(
    config: EnvironmentConfig, copies: int, *, crashes: int = 0, render_mode: str | None = None
) -> BatchedEnvironment:
    """`copies` environments in lockstep.

    crashes: how often in a row a copy may raise and is built anew; beyond, its exception goes to the caller.
    render_mode: PettingZoo's, for copies that shall be rendered (`rgb_array`, `human`).
    """
    return AECStepping(config, copies)
