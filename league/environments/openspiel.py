"""Games of OpenSpiel as PettingZoo AEC environments: `entry_point: openspiel`, `kwargs: {game: kuhn_poker}`."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv

from league.errors import ConfigError

try:
    import pyspiel
except ImportError as error:
    raise ConfigError(
        "environment.entry_point: openspiel requires OpenSpiel: pip install 'policy-league[openspiel]'"
    ) from error


class OpenSpielEnv(AECEnv):
    """A game of OpenSpiel. Observations are dictionaries with `observation` and `action_mask`.

    Outcomes of chance nodes are sampled from the seed. Games with simultaneous moves are played in turns, in which a
    player does not see the moves that the others have made in the same round.
    """

    def __init__(
        self,
        game: str,
        information_state: bool = False,
        render_mode: str | None = None,
        **parameters: bool | int | float | str,
    ) -> None:
        """Load the game.

        Args:
            game: Short name of the game, such as `kuhn_poker`.
            information_state: Observe the information state, which contains all that a player has seen so far, instead
                of the current observation. A game without the one has the other.
            render_mode: `ansi` or None.
            parameters: Parameters of the game, such as `players: 3`.

        Raises:
            ConfigError: OpenSpiel does not have the game or its parameters, or the game cannot be played here.
        """
        super().__init__()
        self._game, self._observes_information = _loaded(game, parameters), information_state
        kind = self._game.get_type()
        if not kind.provides_information_state_tensor or not kind.provides_observation_tensor:
            self._observes_information = kind.provides_information_state_tensor
        shape = (
            self._game.information_state_tensor_shape()
            if self._observes_information
            else self._game.observation_tensor_shape()
        )
        self._shape = tuple(shape)
        self.render_mode = render_mode
        self.metadata = {
            "name": f"openspiel_{kind.short_name}",
            "render_modes": ["ansi"],
            "is_parallelizable": False,
            "hidden_information": kind.information != pyspiel.GameType.Information.PERFECT_INFORMATION,
        }
        self.possible_agents = [f"player_{player}" for player in range(self._game.num_players())]
        observation = np.zeros(self._shape, np.float32)
        actions = self._game.num_distinct_actions()
        observed = spaces.Dict(
            observation=spaces.Box(-np.inf, np.inf, _channels_last(observation).shape, np.float32),
            action_mask=spaces.Box(0, 1, (actions,), np.int8),
        )
        self.observation_spaces = dict.fromkeys(self.possible_agents, observed)
        self.action_spaces = {agent: spaces.Discrete(actions) for agent in self.possible_agents}
        self._generator = np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:  # noqa: ARG002
        """Start a game. Its chance outcomes depend on `seed`."""
        if seed is not None:
            self._generator = np.random.default_rng(seed)
        self.agents = self.possible_agents[:]
        self._state = self._game.new_initial_state()
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        self.agent_selection = self.agents[0]
        self._play_chance()

    def step(self, action: int | None) -> None:
        """Play the move of the current agent, and the chance nodes after it."""
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        before = self._state.returns()
        self._state.apply_action(int(action))  # type: ignore[arg-type]
        self._play_chance()
        returns = zip(self.possible_agents, self._state.returns(), before, strict=True)
        self.rewards = {player: after - earlier for player, after, earlier in returns}
        self._accumulate_rewards()

    def observe(self, agent: str) -> dict[str, NDArray[Any]]:
        """Return what an agent observes. Its mask is 0 while another agent must act."""
        player = self.possible_agents.index(agent)
        state = self._state
        values = (
            state.information_state_tensor(player) if self._observes_information else state.observation_tensor(player)
        )
        acts = not state.is_terminal() and state.current_player() == player
        mask = state.legal_actions_mask(player) if acts else np.zeros(self._game.num_distinct_actions())
        observation = np.array(values, np.float32).reshape(self._shape)
        return {"observation": _channels_last(observation), "action_mask": np.array(mask, np.int8)}

    def render(self) -> str:
        """Return the state as text."""
        return str(self._state)

    def close(self) -> None:
        """Do nothing: a game has no resources."""

    def _play_chance(self) -> None:
        """Sample chance outcomes until a player must act or the game is over."""
        while self._state.is_chance_node():
            outcomes, probabilities = zip(*self._state.chance_outcomes(), strict=True)
            shares = np.array(probabilities)
            self._state.apply_action(int(self._generator.choice(outcomes, p=shares / shares.sum())))
        if self._state.is_terminal():
            self.terminations = dict.fromkeys(self.agents, True)
        else:
            self.agent_selection = self.possible_agents[self._state.current_player()]


def env(game: str, **kwargs: Any) -> OpenSpielEnv:
    """Create an environment. See `OpenSpielEnv`."""
    return OpenSpielEnv(game, **kwargs)


def _loaded(name: str, parameters: dict[str, Any]) -> Any:
    try:
        game = pyspiel.load_game(name, parameters) if parameters else pyspiel.load_game(name)
    except (pyspiel.SpielError, TypeError, RuntimeError) as error:
        message = str(error).partition("\n")[0][:120]
        raise ConfigError(
            f"environment.kwargs: OpenSpiel cannot load game {name!r} with {parameters}: {message}"
        ) from error
    if game.get_type().dynamics == pyspiel.GameType.Dynamics.SIMULTANEOUS:
        game = pyspiel.convert_to_turn_based(game)
    kind = game.get_type()
    if kind.dynamics != pyspiel.GameType.Dynamics.SEQUENTIAL:
        raise ConfigError(f"environment.kwargs: game {name!r} is a mean-field game, which is not supported")
    if kind.chance_mode == pyspiel.GameType.ChanceMode.SAMPLED_STOCHASTIC:
        raise ConfigError(f"environment.kwargs: game {name!r} draws its chance outcomes itself, so it cannot be seeded")
    if not (kind.provides_observation_tensor or kind.provides_information_state_tensor):
        raise ConfigError(f"environment.kwargs: game {name!r} has no observation tensor")
    return game


def _channels_last(observed: NDArray[np.float32]) -> NDArray[np.float32]:
    """Planes (channels, height, width) as an image (height, width, channels), which convolutions expect."""
    return observed.transpose(1, 2, 0) if observed.ndim == 3 else observed
