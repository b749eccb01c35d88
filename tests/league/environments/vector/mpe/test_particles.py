import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mpe2._mpe_utils import core

from league.environments.vector.mpe.particles import Particles, Physics, World, at_rest
from tests.support.examples import examples

SIZES = (0.15, 0.05, 0.2)
COORDINATES = st.floats(-0.5, 0.5)
POINTS = st.tuples(COORDINATES, COORDINATES)


def stock_world(world: World, positions: np.ndarray, velocities: np.ndarray) -> core.World:
    stock = core.World()
    stock.agents = [core.Agent() for _ in range(world.num_agents)]
    stock.landmarks = [core.Landmark() for _ in range(world.num_landmarks)]
    for i, entity in enumerate(stock.entities):
        entity.collide = i < len(world.sizes)
        entity.size = world.sizes[i] if entity.collide else 1.0
        entity.movable = i < world.num_agents
        entity.state.p_pos = positions[i].copy()
    for agent, velocity, speed in zip(stock.agents, velocities, world.max_speeds or [None] * 9, strict=False):
        agent.silent = True
        agent.max_speed = speed
        agent.state.p_vel = velocity.copy()
    return stock


def bits(array: np.ndarray) -> np.ndarray:
    """Distinguishes 0.0 from -0.0. All NaN are equal: their signs depend on the processor."""
    return np.where(np.isnan(array), np.nan, array).view(np.uint64)


@examples(150)
@given(
    st.lists(st.tuples(POINTS, POINTS, POINTS, POINTS, POINTS, POINTS), min_size=1, max_size=4),
    st.sampled_from([SIZES, SIZES[:2], ()]),
    st.sampled_from([(0.4, 1.3), ()]),
)
@example([((0.0, 0.0), (0.1, 0.0), (0.3, 0.3), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))], SIZES, ())
@example([((0.0, 0.0), (0.0, 1e-300), (0.3, 0.3), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))], SIZES, ())
@example([((0.0, 0.0), (0.3, 0.3), (0.4, 0.4), (-0.0, 0.0), (0.0, 0.0), (-0.0, 0.0))], (), ())
@example([((0.0, 0.0), (0.2, 0.0), (0.945, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))], SIZES, (0.4, 1.3))
def test_a_step_equals_that_of_mpe2(
    drawn: list[tuple[tuple[float, float], ...]], sizes: tuple[float, ...], max_speeds: tuple[float, ...]
) -> None:
    """Two agents and a landmark: positions, then velocities and forces of the agents."""
    world = World(2, 1, sizes, accelerations=(5.0, 5.0), max_speeds=max_speeds)
    # (copies, entities, 2)
    points = np.array([[*copy, copy[5]] for copy in drawn])
    # Forces are sums, which are never -0.0.
    positions, velocities, forces = points[:, :3], 4 * points[:, 3:5], 10 * points[:, 5:] + 0.0
    with np.errstate(all="ignore"):
        expected = [stock_step(world, *copy) for copy in zip(positions, velocities, forces, strict=True)]
        particles = in_motion(world, positions, velocities)
        Physics(world).step(particles, np.moveaxis(forces, 0, -1).copy())
    for copy, (stock_positions, stock_velocities) in enumerate(expected):
        np.testing.assert_array_equal(bits(particles.positions[..., copy]), bits(stock_positions))
        np.testing.assert_array_equal(bits(particles.velocities[..., copy]), bits(stock_velocities))


def in_motion(world: World, positions: np.ndarray, velocities: np.ndarray) -> Particles:
    particles = at_rest(world, np.moveaxis(positions, 0, -1).copy())
    particles.velocities[:] = np.moveaxis(velocities, 0, -1)
    return particles


def stock_step(
    world: World, positions: np.ndarray, velocities: np.ndarray, forces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    stock = stock_world(world, positions, velocities)
    for agent, force in zip(stock.agents, forces, strict=True):
        agent.action.u = force
    stock.step()
    return (
        np.array([entity.state.p_pos for entity in stock.entities]),
        np.array([agent.state.p_vel for agent in stock.agents]),
    )


def test_the_repulsion_at_all_distances_equals_that_of_mpe2() -> None:
    """From a deep overlap to a distance at which the repulsion underflows."""
    world = World(2, 0, (0.1, 0.1), accelerations=(5.0, 5.0))
    gaps = np.concatenate([np.linspace(-0.19, 0.1, 1000), np.linspace(0.1, 0.75, 1000)])
    positions = np.zeros((len(gaps), 2, 2))
    positions[:, 1, 0] = 0.2 + gaps
    particles = in_motion(world, positions, np.zeros_like(positions))
    Physics(world).step(particles, np.zeros((2, 2, len(gaps))))
    expected = np.stack([stock_step(world, copy, 0 * copy, 0 * copy)[1] for copy in positions], axis=-1)
    np.testing.assert_array_equal(bits(particles.velocities), bits(expected))
    is_pushed = particles.velocities[1, 0] > 0
    assert is_pushed[:1900].all()
    assert not is_pushed[-10:].any()


@pytest.mark.parametrize("function", [np.exp, np.sqrt, np.square])
def test_functions_of_numpy_round_arrays_as_scalars(function: np.ufunc) -> None:
    """The stock environments call them with scalars. NumPy has several implementations for each processor."""
    values = np.random.default_rng(0).uniform(0, 3, 20_000)
    scalars = np.array([function(value) for value in values])
    np.testing.assert_array_equal(function(values), scalars)
    np.testing.assert_array_equal(function(values[::3]), scalars[::3])
    np.testing.assert_array_equal(function(values.reshape(2, -1).T), scalars.reshape(2, -1).T)


def test_logaddexp_rounds_arrays_as_scalars() -> None:
    values = np.random.default_rng(0).uniform(-800, 300, 20_000)
    np.testing.assert_array_equal(np.logaddexp(0, values), [np.logaddexp(0, value) for value in values])
