"""Patches of PettingZoo environments: corrections and optimisations that do not change their rules.

Each is called with an environment without its wrappers, and changes those that it is for.
"""

import copy
import importlib
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

BASE = "pettingzoo.classic.rlcard_envs.rlcard_base"


def replace_seeding(env: Any) -> None:
    """Replace `_seed` of RLCard games by Reseeding."""
    if any(cls.__module__ == BASE for cls in type(env).__mro__):
        env._seed = Reseeding(env)


class Reseeding:
    """Replaces `_seed` of PettingZoo's RLCard environments.

    PettingZoo creates a game at each seeded reset, which takes 0.6 ms: longer than an episode of Leduc hold'em. A copy
    of an unplayed game whose generator is seeded as in RLCard deals the same cards.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        type(env)._seed(env, seed=0)
        self._unplayed = env.env
        self._generator = np.random.RandomState()

    def __call__(self, seed: int) -> None:
        seeding = importlib.import_module("rlcard.utils.seeding")

        self._generator.seed(seeding._int_list_from_bigint(seeding.hash_seed(seeding.create_seed(seed))))
        fresh = copy.copy(self._unplayed)
        fresh.game = copy.copy(self._unplayed.game)
        fresh.np_random = fresh.game.np_random = self._generator
        self._env.env = fresh


DRAWS_NOTHING_UNRENDERED = (
    "pettingzoo.butterfly.pistonball.pistonball",
    "pettingzoo.butterfly.cooperative_pong.cooperative_pong",
)


def set_render_mode(env: Any) -> None:
    """Set `render_mode` of environments with image observations that are otherwise constant.

    In PettingZoo 1.27 these environments draw their screen, which agents observe, only if `render_mode` is set.
    """
    if type(env).__module__ in DRAWS_NOTHING_UNRENDERED and env.render_mode is None:
        env.render_mode = "rgb_array"
        if hasattr(env, "_kwargs"):
            # Pong recreates its game at each seeded reset.
            env._kwargs = env._kwargs | {"render_mode": "rgb_array"}
            env._seed()


KNIGHTS_ARCHERS_ZOMBIES = "pettingzoo.butterfly.knights_archers_zombies.knights_archers_zombies"


def reset_all_state(env: Any) -> None:
    """Let resets of knights, archers, zombies clear all state.

    Without this patch, the time of the first zombie depends on the previous episode.
    """
    if type(env).__module__ != KNIGHTS_ARCHERS_ZOMBIES:
        return
    stock = env.reset

    def reset(seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        env.zombie_spawn_interval.reset()
        env.kill_list.clear()
        stock(seed=seed, options=options)

    env.reset = reset


PISTONBALL = "pettingzoo.butterfly.pistonball.pistonball"
BGR = (0xFF0000, 0x00FF00, 0x0000FF)
"""Color masks of a screen with the bytes blue, green, red, unused."""


def replace_pictures(env: Any) -> None:
    """Replace `observe` of pistonball by Pictures, if the screen has the expected format."""
    if type(env).__module__ == PISTONBALL and env.render_mode != "human" and sys.byteorder == "little":
        screen = env.screen
        if screen.get_bitsize() == 32 and tuple(screen.get_masks()[:3]) == BGR:
            Pictures(env)


class Pictures:
    """Replaces `observe` of pistonball. Observations are read-only views of one copy of the screen.

    The original copies a part of the screen per agent and color: 0.2 ms each, half of a step with twenty agents. One
    copy of the whole screen takes 0.04 ms.
    """

    def __init__(self, env: Any) -> None:
        self._env, self._draw = env, env.draw
        self._screen: NDArray | None = None
        env.draw, env.observe = self._drawn, self.observe

    def observe(self, agent: str) -> NDArray:
        """Return the screen from one piston to the left to one piston to the right, (height, width, 3) uint8."""
        env = self._env
        if self._screen is None:
            self._screen = _copied(env.screen)
        left = env.wall_width + env.piston_width * (env.agent_name_mapping[agent] - 1)
        top, bottom = env.wall_width, env.screen_height - env.wall_width - env.piston_body_height
        return self._screen[top:bottom, left : left + 3 * env.piston_width]

    def _drawn(self) -> None:
        # Every change of the screen ends with a call of `draw`.
        self._screen = None
        self._draw()


def _copied(screen: Any) -> NDArray:
    """Return the screen as RGB, (height, width, 3) uint8."""
    import pygame

    pixels = np.array(pygame.surfarray.pixels2d(screen).T, dtype=np.uint32, order="C")
    return pixels.view(np.uint8).reshape(*pixels.shape, 4)[..., 2::-1]
