import itertools

import numpy as np
import pytest

from policy_league.examples.traffic import GREEN, RED, Crossing, lights_reward, move, optimum, starts


def test_waiting_at_red_costs_and_two_cars_in_the_crossing_crash() -> None:
    state, rewards = move(((1, 3), (2, 4)), (RED, GREEN), ((1, 0), (0, 0)))
    assert state == ((0, 3), (2, 4))
    assert rewards == ((-11.0, -1.0), (-1.0, -1.0))
    _, rewards = move(((1, 3), (1, 4)), (GREEN, GREEN), ((1, 0), (1, 0)))
    assert (rewards[0][0], rewards[1][0]) == (-21.0, -21.0)


def test_a_car_does_not_drive_into_the_one_ahead() -> None:
    state, _ = move(((1, 2), (0, 0)), (RED, RED), ((0, 1), (0, 0)))
    assert state == ((1, 2), (0, 0))
    state, _ = move(((1, 2), (0, 0)), (GREEN, RED), ((1, 1), (0, 0)))
    assert state == ((0, 1), (0, 0))


def test_the_optimum_with_one_car_per_road_equals_the_manual_result() -> None:
    """Both cars start at 1, both lights are red: one light turns green (step 1), a car passes while the other light
    turns green (step 2), the other car passes (step 3). Cars: −2 and −3; lights, each: −1, −1, −½.
    """
    assert optimum(cars=1, length=1) == pytest.approx((-2 - 3 + 2 * (-1 - 1 - 0.5)) / 4)


def test_random_play_does_not_exceed_the_optimum_and_rewards_follow_the_rules() -> None:
    env, best = Crossing(cars=1, length=2), optimum(cars=1, length=2)
    returns = []
    rng = np.random.default_rng(0)
    for seed in range(300):
        env.reset(seed=seed)
        total = 0.0
        for _ in itertools.count():
            before, colours = env.distances, env.colours
            actions = {agent: int(rng.integers(2)) for agent in env.agents}
            _, rewards, terminated, truncated, _ = env.step(actions)
            assert rewards["light_0"] == lights_reward(before, colours)
            total += sum(rewards.values())
            if terminated["__all__"] or truncated["__all__"]:
                break
        returns.append(total / 4)
    assert np.mean(returns) < best
    assert len(starts(1, 2)) == 4


def test_cars_leave_and_lights_remain_until_the_end() -> None:
    env = Crossing(cars=1, length=1)
    env.reset(seed=0)
    env.step(dict.fromkeys(env.agents, 0) | {"light_0": GREEN})
    observations, _, terminated, truncated, _ = env.step(dict.fromkeys(env.agents, 1) | {"car_1_0": 0, "light_0": RED})
    assert terminated == {"car_0_0": True, "car_1_0": False, "__all__": False}
    assert not truncated["__all__"]
    assert set(env.agents) == {"car_1_0", "light_0", "light_1"}
    assert set(observations) == {"car_0_0", *env.agents}
    for agent, observation in observations.items():
        assert env.observation_spaces[agent].contains(observation)
    assert env.render().shape == (72, 72, 3)
