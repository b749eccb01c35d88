import numpy as np

from evaluation.matches.game_state import AgentGenerators, AgentStates
from league.environments.stepping import Batch
from league.random.seeds import generator


def batch(envs: list[int], agents: list[int]) -> Batch:
    return Batch(np.array(envs), np.array(agents), {}, np.zeros(len(envs)))


def test_generators_continue_until_their_game_is_over() -> None:
    kept = AgentGenerators(num_envs=3, agents=2)
    rows = batch([0, 2], [1, 0])
    seeds, numbers = np.array([5, 2**62]), np.array([0, 1])
    first = kept.get(rows, seeds, numbers)
    drawn = [each.random() for each in first]
    assert drawn == [generator(5, "policy", 0, 1).random(), generator(2**62, "policy", 1, 0).random()]
    assert kept.get(rows, seeds, numbers) == first
    kept.forget(np.array([2]))
    again = kept.get(rows, seeds, numbers)
    assert again[0] is first[0]
    assert again[1].random() == drawn[1]


def test_missing_states_are_zero() -> None:
    states = AgentStates(num_envs=3, agents=2)
    assert states.get(batch([0, 1], [1, 1])) is None
    states.update(batch([0, 2], [1, 1]), {"state_in_0": np.array([[3.0], [5.0]])})
    found = states.get(batch([0, 1, 2], [1, 1, 1]))
    assert found is not None
    assert found["state_in_0"].tolist() == [[3.0], [0.0], [5.0]]
    states.forget(np.array([0]))
    assert states.get(batch([0, 1], [1, 1])) is None
