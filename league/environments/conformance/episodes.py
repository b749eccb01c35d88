"""Plays episodes with random legal actions, records them, and checks what the environment reports."""

import math
import random
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from league.config.league import LeagueConfig
from league.environments.adapters import EnvAdapter, Report, adapter_for
from league.environments.building import build
from league.environments.conformance.findings import Examination
from league.environments.conformance.observations import ObservationCheck, check_constant_observations
from league.environments.conformance.openings import measure_openings
from league.environments.conformance.recordings import Recording, joined
from league.environments.conformance.time_budget import TimeBudget
from league.environments.vector.random_actions import random_actions
from league.errors import EnvironmentMismatch, IllegalMask, LeagueError, no_exit, one_line, raised_at
from league.interface import Interface
from league.random.seeds import derive
from league.spaces import ACTION_MASK
from league.spaces.arrays import check_mask, environment_actions, mask_size

REPETITIONS = 4
"""Further new environments, for those that draw from a common generator: tosses of a coin are often equal."""
FIRST, RETURNS, OPENINGS = 0.2, 0.7, 0.9
"""Shares of the time after which no further episodes are played: the first ones, which are repeated; those that compare
returns; random openings."""
GAMES, LONGEST_GAME = 20, 100
"""Games of which the returns of agents are compared, and the steps after which they are cut."""
AGREEMENT = 0.75
"""Correlation of the returns of all agents from which they may be one team: in MPE, teams have 0.75 to 1."""


class Examiner:
    """Plays episodes of one environment and adds what is wrong with them to an examination.

    Attributes:
        recording: The newest episode. It says where the environment raised an exception.
    """

    def __init__(
        self, env: Any, interface: Interface, config: LeagueConfig, examination: Examination, budget: TimeBudget
    ) -> None:
        self._env, self._config, self._examination, self._budget = env, config, examination, budget
        self._agents, self._sides = list(interface.agents), interface.sides
        self._spaces = [spaces.action for spaces in interface.agents.values()]
        normalizes = config.training.normalize_observations
        self._checks = [ObservationCheck(agent, env, examination, normalizes) for agent in self._agents]
        self._adapter = adapter_for(env, self._checks)
        self.recording = Recording(0)

    def examine(self, episodes: int, seed: int, steps: int | None) -> None:
        """Play episodes, each twice and the first one in a new environment too, and measure random openings.

        Raises what the environment raises.

        Args:
            episodes: Number of episodes.
            seed: Seed of the first one.
            steps: Maximum number of steps per episode. None: episodes must end within `play.max_moves` steps.
        """
        examination, budget = self._examination, self._budget
        most = self._config.play.max_moves if steps is None else steps
        began = time.perf_counter()
        first: list[Recording] = []
        while len(first) < episodes and not (first and budget.is_spent(FIRST)):
            doing = f"episode {len(first) + 1} of {episodes}"
            first.append(self.play(seed + len(first), doing, most, share=FIRST))
            if first[-1].steps < most or first[-1].is_whole:
                continue
            if steps is None:
                raise EnvironmentMismatch(
                    f"the episode with seed {first[-1].seed} did not end within {most:,} steps (play.max_moves), after"
                    " which a match fails: terminate or truncate it in the environment, or raise play.max_moves"
                )
            examination.add("note", f"an episode did not end within {most} steps (--steps)")
        examination.lengths = [episode.steps for episode in first]
        examination.steps_per_second = sum(examination.lengths) / (time.perf_counter() - began)
        is_whole = all(episode.is_whole for episode in first)
        if is_whole:
            examination.actions_per_episode = max(episode.actions for episode in first)
        if budget.is_spent(FIRST) and (len(first) < episodes or not is_whole):
            cut = "" if is_whole else f", the last one only to step {first[-1].steps}"
            budget.skipped.append(f"{len(first)} of {episodes} episodes were played{cut}")
        self._check_seeding(first)
        self._check_thread(first[0])
        check_constant_observations(first, self._env, examination)
        if is_whole:
            _check_endings(first, examination)
        self._check_returns(first, seed + episodes)
        examination.openings = measure_openings(self.play, seed, budget, OPENINGS)
        if examination.openings is None:
            budget.skipped.append("random openings were not measured")
        _check_openings(self._config.play.opening_plies, examination)

    def play(
        self,
        seed: int,
        doing: str,
        most: int,
        *,
        adapter: EnvAdapter | None = None,
        share: float | None = None,
        states: bool = False,
        actions_seed: int | None = None,
    ) -> Recording:
        """Play an episode with random legal actions, and check its reports.

        Args:
            seed: Seed of the episode.
            doing: What the progress says.
            most: Steps after which the episode is cut.
            adapter: A new environment; by default the one that is examined.
            share: Share of the time after which it is cut.
            states: Check the global state at each step.
            actions_seed: Seed of the actions; that of the episode by default.
        """
        adapter = adapter or self._adapter
        recording = self.recording = Recording(seed)
        reports = adapter.reset(seed)
        actions_seed = seed if actions_seed is None else actions_seed
        generators = [np.random.default_rng(derive(actions_seed, agent)) for agent in range(len(self._agents))]
        while True:
            recording.turns.append(reports)
            if states:
                self._check_state(adapter)
            moves = []
            for report in reports:
                self._check_report(report, adapter)
                agent, observation, _, terminated, truncated = report
                if not (terminated or truncated):
                    mask, space = observation.get(ACTION_MASK), self._spaces[agent]
                    rows = None if mask is None else mask[np.newaxis]
                    action = random_actions(space, 1, rows, generators[agent])
                    moves.append((agent, environment_actions(action, space)[0]))
            recording.is_whole = not moves
            is_late = share is not None and recording.steps > 0 and self._budget.is_spent(share)
            if not moves or recording.steps == most or is_late:
                return recording
            self._budget.report(f"{doing}, step {recording.steps + 1}")
            reports = adapter.step(moves)

    def _check_report(self, report: Report, adapter: EnvAdapter) -> None:
        agent, observation, reward, terminated, truncated = report
        name, add = self._agents[agent], self._examination.add
        if not math.isfinite(reward):
            add("fault", f"got a reward of {reward}, expected a finite number", name)
        if terminated and truncated:
            add("note", "was both terminated and truncated: treated as terminated", name)
        for part, array in observation.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                add("fault", f"observes NaN or infinity in {part}", name)
        if terminated or truncated:
            return
        if ACTION_MASK in observation:
            try:
                check_mask(observation[ACTION_MASK][np.newaxis])
            except IllegalMask as error:
                add("fault", str(error), name)
        elif mask_size(self._spaces[agent]) is not None and (
            isinstance(info := adapter.infos.get(name), Mapping) and ACTION_MASK in info
        ):
            # It is not used, because no info had one after the first reset.
            text = "gets a mask in its info after a step, but no agent gets one after reset: report masks from reset on"
            add("fault", text, name)

    def _check_state(self, adapter: EnvAdapter) -> None:
        """Centralised learners need a global state of a fixed size."""
        examination = self._examination
        try:
            with no_exit:
                raw_state = adapter.state()
            state = None if raw_state is None else np.asarray(raw_state, dtype=np.float32)
        except Exception as error:
            reason = one_line(error, with_type=True)
            text = f"its global state, which only centralised learners need, cannot be read: {reason}"
            examination.add("note", text)
            return
        if state is None:
            return
        if examination.state_size not in (None, state.size):
            example = f"{state.size} numbers, after {examination.state_size}"
            examination.add("fault", "its global state has no fixed size", example=example)
        if not np.isfinite(state).all():
            examination.add("fault", "its global state has NaN or infinity")
        examination.state_size = state.size

    def _check_seeding(self, first: Sequence[Recording]) -> None:
        """Play the same episodes again, in reverse order, and the first one in new environments."""
        # After the timing, because a global state may be a large image.
        again = [
            self.play(episode.seed, "the same episodes again", episode.steps, states=True) for episode in first[::-1]
        ]
        before = _global_generators()
        anew = [self._anew(first[0])]
        drawn = [name for name, state in _global_generators().items() if state != before[name]]
        while drawn and len(anew) <= REPETITIONS and not self._budget.is_spent(FIRST):
            anew.append(self._anew(first[0]))
        pairs = [*zip(first, again[::-1], strict=True), *((first[0], episode) for episode in anew)]
        change = next((change for one, other in pairs if (change := self._change(one, other))), None)
        if change is None:
            return
        if len(anew) == 1:
            anew.append(self._anew(first[0]))
        if any(self._change(anew[0], episode) for episode in anew[1:]):
            text = (
                "the same seed gives another episode in each new environment: all randomness must follow the seed of"
                " reset"
            ) + "".join(f", and it draws from the generator of the module {name}" for name in drawn)
        else:
            text = "the same seed gives another episode after other episodes: reset must clear all state"
        self._examination.add("fault", text, example=change)

    def _anew(self, episode: Recording, share: float | None = None) -> Recording:
        """Play an episode in a new environment. share: see `play`."""
        with closing(adapter_for(build(self._config.environment), self._checks)) as fresh:
            doing = "the first episode in a new environment"
            return self.play(episode.seed, doing, episode.steps, adapter=fresh, share=share)

    def _check_thread(self, episode: Recording) -> None:
        """Play an episode, which a new environment has played here, outside of the main thread, as training does."""
        errors: list[Exception] = []

        def play() -> None:
            try:
                with no_exit:
                    self._anew(episode, FIRST)
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=play, name="episode", daemon=True)
        thread.start()
        thread.join()
        for error in errors:
            where = "".join(f"{line}, " for line in [raised_at(error)] if line)
            self._examination.add(
                "fault",
                "outside of the main thread, where training plays too, the environment raised an exception"
                f" ({where}{self.recording.place}): {one_line(error, with_type=not isinstance(error, LeagueError))}."
                " Signals, for example, work only in the main thread: limit times by timeouts of sockets, subprocesses"
                " or threads",
            )

    def _change(self, one: Recording, other: Recording) -> str:
        """Describe the first report that differs between two episodes; empty if they are equal."""
        names = ("agent", "observation", "reward", "termination", "truncation")
        for number, reports in enumerate(zip(one.reports, other.reports, strict=False), start=1):
            # NaN is equal to itself, and 0 to -0.
            before, after = (
                (agent, joined(observation), str(reward + 0.0), *flags)
                for agent, observation, reward, *flags in reports
            )
            for name, value, changed in zip(names, before, after, strict=True):
                if value != changed:
                    return f"the {name} in report {number}, of {self._agents[reports[0][0]]}"
        return "the length of an episode" if len(one.reports) != len(other.reports) else ""

    def _check_returns(self, first: Sequence[Recording], seed: int) -> None:
        """Find agents whose returns agree, as those of a team do."""
        whole = [episode for episode in first if episode.is_whole]
        if not whole or len(self._agents) == 1:
            return
        games = [episode.returns(len(self._agents)) for episode in whole]
        if _agreement(games) != 1.0:
            # Returns of episodes of very different lengths would agree by their lengths.
            games = [game for game, episode in zip(games, whole, strict=True) if episode.steps <= LONGEST_GAME]
        while len(games) < GAMES and _agreement(games) != 1.0 and not self._budget.is_spent(RETURNS):
            doing = f"returns of game {len(games) + 1} of {GAMES}"
            game = self.play(seed + len(games), doing, LONGEST_GAME, share=RETURNS)
            games.append(game.returns(len(self._agents)))
        agreement = self._examination.agreement = _agreement(games)
        if agreement is not None and agreement >= AGREEMENT and len(self._sides) > 1 and self._config.sides is None:
            how = "are equal" if agreement == 1.0 else f"agree (correlation {agreement:.2f} in {len(games)} games)"
            self._examination.add(
                "note",
                f'the returns of all agents {how}: are they one team? A team is one side: `sides: {{team: ["*"]}}`',
            )


def _agreement(games: Sequence[Sequence[float]]) -> float | None:
    """Return the smallest correlation between the returns (games, agents) of two agents.

    1 if all agents have equal returns that are not always 0. None if there are too few games, or constant returns.
    """
    if len(games) < 2:
        return None
    returns = np.array(games)
    if np.allclose(returns, returns[:, :1], rtol=1e-6) and returns.any():
        return 1.0
    if len(games) < GAMES or not returns.std(axis=0).all():
        return None
    return min(float(np.corrcoef(returns.T).min()), 0.999)


def _global_generators() -> dict[str, object]:
    """The states of the generators that all code shares, by module."""
    legacy: Any = np.random.get_state()
    return {"random": random.getstate(), "numpy.random": (legacy[1].tobytes(), legacy[2])}


def _check_endings(episodes: Sequence[Recording], examination: Examination) -> None:
    """Find games without rewards and without endings, which are known faults of Shimmy's OpenSpiel environments.

    A limit of steps truncates all episodes at the same length, and rewards can be rare: this is no fault.
    """
    ends = Counter[str]()
    for *_, reward, terminated, truncated in (report for episode in episodes for report in episode.reports):
        ends.update(rewards=reward != 0, terminated=terminated, truncated=truncated)
    all_truncated = ends["truncated"] and not ends["terminated"]
    if all_truncated and not ends["rewards"] and len({len(episode.reports) for episode in episodes}) > 1:
        examination.add(
            "fault",
            "all episodes were truncated and all rewards were 0: the environment does not report how its games end"
            " (games of OpenSpiel: use `entry_point: openspiel` instead of Shimmy)",
        )
    elif not ends["rewards"]:
        examination.add("note", f"all rewards were 0 in {len(episodes)} episodes: a policy cannot learn from them")
    elif all_truncated:
        examination.add("note", "all episodes were truncated, none was terminated: their last values are bootstrapped")


def _check_openings(plies: int, examination: Examination) -> None:
    """Compare `play.opening_plies` with what is recommended."""
    openings = examination.openings
    if openings is None:
        return
    if openings.recommended and not plies:
        best = openings.recommended
        examination.add("note", f"greedy policies would repeat one game: set play.opening_plies, for example to {best}")
    if not 0 < plies <= len(openings.lengths):
        return
    if warning := openings.warning(plies):
        text = f"play.opening_plies: {plies} is long for this game. {openings.effect(plies)}. {warning}"
        examination.add("note", text)
    if openings.lengths[plies - 1].positions <= 1:
        examination.add("note", f"play.opening_plies: {plies} does nothing. {openings.effect(plies)}")
