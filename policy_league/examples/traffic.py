"""Cars and traffic lights at a crossing: an RLlib MultiAgentEnv with two kinds of agents and spaces.

On each of two crossing roads, cars wait in line at random distances before a traffic light. In each step, a car waits
or drives one cell, and a light sets its colour for the next step. A car that drives from distance 1 passes the crossing
and leaves. Agents depend on each other: cars only pass safely at green, two green lights are dangerous, and a car that
passes at red may collide with the other road's. Everything but the initial distances is deterministic.

| | reward in each step |
|---|---|
| car | −1 until it has passed; −10 for passing at red; −20 for passing together with a car of the other road |
| light | −½ for each car that has not passed; −5 if both are green |
"""

from itertools import combinations, product
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from ray.rllib.env.multi_agent_env import MultiAgentEnv

ROADS = 2
RED, GREEN = 0, 1
AT_RED, CRASH, BOTH_GREEN, WAITING = -10.0, -20.0, -5.0, -0.5

Distances = tuple[tuple[int, ...], ...]
"""road → car → cells to the crossing; 0 if it has passed. The first car of a road is the nearest."""
Colours = tuple[int, ...]


class Crossing(MultiAgentEnv):
    """Agents `car_<road>_<place>` and `light_<road>`.

    A car observes Box(6 + cars,) float32: its distance, its light's colour, the other light's colour, the distance of
    the
    car ahead (0: none), its road and place, then the distances on the other road. A light observes MultiDiscrete: all
    distances, its own road's first, its colour, the other's, and its road, so that the two lights can act differently
    although they share a policy. All act Discrete(2): wait or drive, red or green.
    """

    def __init__(self, cars: int = 2, length: int = 4, steps: int = 20, render_mode: str | None = None) -> None:
        """cars: on each road. length: cells before the crossing. steps: after which the episode is truncated."""
        super().__init__()
        self.cars, self.length, self.steps, self.render_mode = cars, length, steps, render_mode
        self.lights = [f"light_{road}" for road in range(ROADS)]
        self.place = {f"car_{road}_{i}": (road, i) for road in range(ROADS) for i in range(cars)}
        self.possible_agents = [*self.place, *self.lights]
        self.agents: list[str] = []
        light = spaces.MultiDiscrete([length + 1] * ROADS * cars + [2] * ROADS + [ROADS])
        car = spaces.Box(0, max(length, cars), (6 + cars,), np.float32)
        self.observation_spaces = {agent: car if agent in self.place else light for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(2) for agent in self.possible_agents}
        self.starts = starts(cars, length)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Draw initial distances; both lights are red."""
        self.distances = self.starts[int(np.random.default_rng(seed).integers(len(self.starts)))]
        self.colours: Colours = (RED,) * ROADS
        self.time = 0
        self.agents = list(self.possible_agents)
        return self._observations(), {}

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        """Take a step of all agents that are present."""
        drives = tuple(tuple(actions.get(f"car_{road}_{i}", 0) for i in range(self.cars)) for road in range(ROADS))
        next_colours = tuple(actions[light] for light in self.lights)
        before = self.distances
        self.distances, rewards = move(before, self.colours, drives)
        light_reward = lights_reward(before, self.colours)
        self.colours, self.time = next_colours, self.time + 1
        paid = {agent: rewards[road][i] for agent, (road, i) in self.place.items() if agent in self.agents}
        paid |= dict.fromkeys(self.lights, light_reward)
        passed = {
            agent: self.distances[road][i] == 0 for agent, (road, i) in self.place.items() if agent in self.agents
        }
        self.agents = [agent for agent in self.agents if not passed.get(agent, False)]
        all_passed = not any(map(any, self.distances))
        terminated = passed | {"__all__": all_passed}
        truncated = {"__all__": self.time >= self.steps and not all_passed}
        observations = self._observations() | {a: self._observation(a) for a, gone in passed.items() if gone}
        return observations, paid, terminated, truncated, {}

    def render(self) -> NDArray:
        """Return (height, width, 3) uint8: the roads, their lights, and the cars as squares."""
        cell, cells = 24, 2 * self.length + 1
        picture = np.full((cells * cell, cells * cell, 3), 40, np.uint8)
        middle = slice(self.length * cell, (self.length + 1) * cell)
        picture[middle], picture[:, middle] = 90, 90
        lamp = {RED: (210, 60, 50), GREEN: (70, 190, 90)}
        for road, colour in enumerate(self.colours):
            at = ((self.length - 1) * cell + 4, self.length * cell - 8)
            rows, columns = (at[1], at[0]) if road == 0 else (at[0], at[1])
            picture[rows : rows + 8, columns : columns + 8] = lamp[colour]
        for agent, (road, i) in self.place.items():
            if agent not in self.agents:
                continue
            along = (self.length - self.distances[road][i]) * cell + 5
            across = self.length * cell + 5
            rows, columns = (across, along) if road == 0 else (along, across)
            picture[rows : rows + 14, columns : columns + 14] = (90, 150, 230) if road == 0 else (235, 170, 70)
        return picture

    def _observations(self) -> dict[str, Any]:
        return {agent: self._observation(agent) for agent in self.agents}

    def _observation(self, agent: str) -> NDArray:
        if agent not in self.place:
            road = self.lights.index(agent)
            order = (road, 1 - road)
            distances = [distance for r in order for distance in self.distances[r]]
            return np.array([*distances, *(self.colours[r] for r in order), road], np.int64)
        road, i = self.place[agent]
        cars, crossing_cars = self.distances[road], self.distances[1 - road]
        ahead = cars[i - 1] if i else 0
        return np.array(
            [cars[i], self.colours[road], self.colours[1 - road], ahead, road, i, *crossing_cars], np.float32
        )


def crossing(**kwargs: Any) -> Crossing:
    """Entry point for configurations."""
    return Crossing(**kwargs)


def starts(cars: int, length: int) -> list[Distances]:
    """Return all initial distances; they are equally likely."""
    one_road = list(combinations(range(1, length + 1), cars))
    return [tuple(both) for both in product(one_road, repeat=ROADS)]


def move(distances: Distances, colours: Colours, drives: Distances) -> tuple[Distances, tuple[tuple[float, ...], ...]]:
    """Return the distances after a step, and each car's reward; 0 for cars that passed earlier."""
    passing = [
        any(distance == 1 and drive for distance, drive in zip(*road, strict=True))
        for road in zip(distances, drives, strict=True)
    ]
    after, rewards = [], []
    for road in range(ROADS):
        moved: list[int] = []
        paid: list[float] = []
        for i, (distance, drive) in enumerate(zip(distances[road], drives[road], strict=True)):
            if distance == 0:
                moved.append(0)
                paid.append(0.0)
                continue
            reward = -1.0
            target = distance - 1 if drive else distance
            if i and target and moved[i - 1] == target:
                target = distance  # the car ahead is there
            if target == 0:
                reward += (AT_RED if colours[road] == RED else 0.0) + (CRASH if all(passing) else 0.0)
            moved.append(target)
            paid.append(reward)
        after.append(tuple(moved))
        rewards.append(tuple(paid))
    return tuple(after), tuple(rewards)


def lights_reward(distances: Distances, colours: Colours) -> float:
    """Return each light's reward for a step that starts in this state."""
    left = sum(distance > 0 for road in distances for distance in road)
    return WAITING * left + (BOTH_GREEN if all(colours) else 0.0)
