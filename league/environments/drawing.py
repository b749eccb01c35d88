"""Pistonball and cooperative pong drawn whatever their render mode: their observations are pictures of the screen.

In PettingZoo 1.27 both draw only where `render_mode` is set. Without it, an agent sees the same picture all through an
episode, and can learn nothing.
"""

from typing import Any

MODULES = (
    "pettingzoo.butterfly.pistonball.pistonball",
    "pettingzoo.butterfly.cooperative_pong.cooperative_pong",
)


def with_drawing(env: Any) -> Any:
    """One of the two, wherever it is in `env`, so drawn. Any other environment as it is."""
    bare = getattr(env, "unwrapped", env)
    if type(bare).__module__ in MODULES and bare.render_mode is None:
        bare.render_mode = "rgb_array"
        if hasattr(bare, "_kwargs"):
            # Pong makes its game anew at each seeded reset.
            bare._kwargs = bare._kwargs | {"render_mode": "rgb_array"}
            bare._seed()
    return env
