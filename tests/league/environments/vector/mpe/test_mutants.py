"""Mutants of the vectorised MPE environments: the differential test finds each."""

from dataclasses import dataclass, field
from typing import Any

import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from tests.support.environments.mutants import Mutation, mutated

PACKAGE = "league.environments.vector.mpe"
MODULES = {
    "pcg64": "league.random.pcg64",
    "particles": f"{PACKAGE}.particles",
    "initial_states": f"{PACKAGE}.initial_states",
    "particle_env": f"{PACKAGE}.particle_env",
}
"""Each imports only earlier ones of them."""
CLASSES = {
    "simple_spread": "SimpleSpread",
    "simple_adversary": "SimpleAdversary",
    "simple_tag": "SimpleTag",
    "simple_reference": "SimpleReference",
}
REUSED_ARRAY = """\
kept = self.__dict__.setdefault(
            str((len(parts), len(particles.steps))),
            np.zeros((len(particles.steps), sum(map(len, parts))), dtype=np.float32)
        )
        kept[:] = np.concatenate(parts).T
        return kept
"""


@dataclass(frozen=True)
class Fault:
    """`new` replaces `old` in a module. It is looked for in `environment`."""

    module: str
    old: str
    new: str
    environment: str = "simple_spread"
    kwargs: dict[str, Any] = field(default_factory=dict)


CONTINUOUS = {"continuous_actions": True}
PARTICLES = [
    Fault("particles", "DAMPING = 0.25", "DAMPING = 0.2500001"),
    Fault("particles", "-(distances - self._contacts) /", "-(distances + self._contacts) /"),
    Fault("particles", "-(distances - self._contacts) / CONTACT_MARGIN", "(self._contacts - distances) * 1e3"),
    Fault("particles", "UNDERFLOW = -746.0", "UNDERFLOW = -20.0"),
    Fault("particles", "np.logaddexp(0, exponents[near])", "np.maximum(0, exponents[near])"),
    Fault("particles", "forces[a] += repulsion", "forces[a] -= repulsion"),
    Fault("particles", "if b < len(forces):", "if False:"),
    Fault(
        "particles",
        "CONTACT_FORCE * deltas / distances[:, np.newaxis]",
        "CONTACT_FORCE * (deltas / distances[:, np.newaxis])",
    ),
    Fault(
        "particles",
        "zip(self._pairs, repulsions, strict=True)",
        "reversed(list(zip(self._pairs, repulsions)))",
        "simple_tag",
    ),
    Fault("particles", "forces *= TIME_STEP", "velocities += forces * TIME_STEP; return", "simple_tag"),
    Fault("particles", "if a < world.num_agents]", "if b < world.num_agents]", "simple_tag"),
    Fault("particles", "* self._max_speeds[agents]", "* self._max_speeds[0]", "simple_tag"),
    Fault("particles", "array[..., envs] = new", "array[..., : new.shape[-1]] = new"),
    Fault("particles", "steps=np.zeros(n", "steps=np.ones(n"),
    Fault("particles", "velocities=np.zeros", "velocities=np.ones"),
    Fault("particles", "squares[..., 0, :] + squares[..., 1, :]", "squares[..., 0, :] + squares[..., 0, :]"),
]
PARTICLE_ENV = [
    Fault("particle_env", "particles.steps >= self._max_cycles", "particles.steps > self._max_cycles"),
    Fault("particle_env", "[0.0, -1.0, 1.0, 0.0, 0.0]", "[0.0, 1.0, -1.0, 0.0, 0.0]"),
    Fault("particle_env", "np.tile(np.array(agents), len(env_ids))", "np.array(agents).repeat(len(env_ids))"),
    Fault("particle_env", "agent, self.others[agent])", "agent, self.others[agent][::-1])"),
    Fault("particle_env", "env_ids.repeat(len(agents))", "np.tile(env_ids, len(agents))"),
    Fault("particle_env", "dtype=np.float32, casting", "dtype=np.float64, casting"),
    Fault(
        "particle_env",
        'return np.ascontiguousarray(np.concatenate(parts, dtype=np.float32, casting="same_kind").T)',
        REUSED_ARRAY,
    ),
    Fault("particle_env", "- actions[:, 1::2])", "- actions[:, :-1:2])", kwargs=CONTINUOUS),
    Fault("particle_env", "- actions[:, 1::2])", "- actions[:, 1::2].astype(np.float64))", kwargs=CONTINUOUS),
    Fault("particle_env", "self._particles.update(env_ids, particles)\n        rewards", "rewards"),
    Fault("particle_env", "self._particles.update(env_ids, particles)\n        return", "return"),
    Fault("particle_env", "particles.messages[:] = self._messages(actions)", "pass", "simple_reference"),
    Fault("particle_env", "actions // 5", "actions // 5 % 9", "simple_reference"),
    Fault("particle_env", "actions[:, 5:], 0", "actions[:, -11:-1], 0", "simple_reference", CONTINUOUS),
]
DRAWS = [
    Fault("pcg64", "(outputs >> np.uint64(11))", "(outputs >> np.uint64(10))"),
    Fault("pcg64", " + (sum_low < low[0])", ""),
    Fault("pcg64", "return low + (high - low) * fractions", "return high - (high - low) * fractions"),
    Fault("initial_states", "outputs[1:]", "outputs[:-1]", "simple_adversary"),
    Fault("initial_states", "outputs[0] >> 32", "outputs[1]", "simple_reference"),
]
SPREAD = [
    Fault("simple_spread", "SIZE = 0.15", "SIZE = 0.151"),
    Fault(
        "simple_spread",
        "coverage * (1 - self._local_ratio)",
        "coverage * self._local_ratio",
        kwargs={"local_ratio": 0.3},
    ),
    Fault("simple_spread", ".min(axis=0):", ".min(axis=1):"),
    Fault("simple_spread", ".min(axis=0):", ".min(axis=0)[::-1]:"),
    Fault("simple_spread", "< SIZE + SIZE", "< SIZE"),
    Fault("simple_spread", "collisions[b] -= hits", "collisions[b] += hits"),
    Fault("simple_spread", "silence = np.zeros(", "silence = np.ones("),
]
ADVERSARY = [
    Fault("simple_adversary", "[0] - particles.", "[0] + particles.", "simple_adversary"),
    Fault("simple_adversary", "+ distances[0]", "- distances[0]", "simple_adversary"),
    Fault("simple_adversary", "-distances[1:].min", "-distances.min", "simple_adversary"),
    Fault("simple_adversary", "[-distances[0], *", "[distances[0], *", "simple_adversary"),
    Fault("simple_adversary", "if agent == 0:", "if agent == 1:", "simple_adversary"),
    Fault(
        "simple_adversary",
        "draw(self, seeds: NDArray[np.int64]) -> Particles:",
        "draw(self, seeds: NDArray[np.int64]) -> Particles:\n        seeds = seeds + 1",
        "simple_adversary",
    ),
]
TAG = [
    Fault("simple_tag", "obstacles, -0.9, 0.9", "obstacles, -1.0, 1.0", "simple_tag"),
    Fault("simple_tag", "GOOD_SPEED = 1.0, 1.3", "GOOD_SPEED = 1.0, 1.0", "simple_tag"),
    Fault(
        "simple_tag",
        "other_agents[other_agents >= self._adversaries]",
        "other_agents[other_agents < self._adversaries]",
        "simple_tag",
    ),
    Fault("simple_tag", "distances < 0.9", "distances <= 0.95", "simple_tag"),
    Fault("simple_tag", "np.exp(2 * distances[outside] - 2)", "np.exp(distances[outside] - 1) ** 2", "simple_tag"),
    Fault("simple_tag", "- horizontal - vertical", "- horizontal + vertical", "simple_tag"),
    Fault("simple_tag", "contacts.sum(axis=1)", "contacts.any(axis=1)", "simple_tag", {"num_adversaries": 8}),
    Fault("simple_tag", "caught.sum(axis=0)", "caught.max(axis=0)", "simple_tag", {"num_good": 3}),
]
REFERENCE = [
    Fault("simple_reference", "particles.positions[[1, 0]]", "particles.positions[[0, 1]]", "simple_reference"),
    Fault("simple_reference", "particles.goals[agent]", "particles.goals[1 - agent]", "simple_reference"),
    Fault("simple_reference", "particles.messages[1 - agent]", "particles.messages[agent]", "simple_reference"),
    Fault("simple_reference", "own_rewards[1]) / 2", "own_rewards[1])", "simple_reference"),
    Fault("simple_reference", "COLORS.take", "COLORS[::-1].take", "simple_reference"),
]


def name(fault: Fault) -> str:
    return f"{fault.module}: {fault.old} -> {fault.new}"[:90]


@pytest.mark.slow
@pytest.mark.parametrize("fault", [*PARTICLES, *PARTICLE_ENV, *DRAWS, *SPREAD, *ADVERSARY, *TAG, *REFERENCE], ids=name)
def test_each_mutant_is_found(fault: Fault) -> None:
    wanted = f"{PACKAGE}.{fault.environment}"
    mutation = Mutation(MODULES.get(fault.module, wanted), fault.old, fault.new)
    with mutated(mutation, [*MODULES.values(), wanted]) as module:
        vector = getattr(module, CLASSES[fault.environment])(16, **fault.kwargs)
        config = EnvironmentConfig(entry_point=f"mpe2.{fault.environment}_v3", kwargs=fault.kwargs)
        assert compare(config, vector, steps=8000, seed=0).difference is not None
