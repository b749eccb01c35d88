"""A callback for games of two players: how often the first one wins, and the best return so far."""

from training.runs.callbacks import FinishedEpisode


class FirstPlayer:
    """Metrics of each episode, `first_player` and `draws`, and of each update, `best_return`."""

    def __init__(self) -> None:
        self.best = float("-inf")

    def on_episode(self, episode: FinishedEpisode) -> dict[str, float] | None:
        """Score an episode; none against an opponent, whose return is missing."""
        if len(episode.returns) < 2:
            return None
        first, second = episode.returns.values()
        return {"first_player": float(first > second), "draws": float(first == second)}

    def on_update(self, metrics: dict[str, float]) -> dict[str, float]:
        """Remember the highest return of the first agent."""
        returns = [value for name, value in metrics.items() if name.startswith("agents/") and name.endswith("/return")]
        self.best = max([self.best, *returns[:1]])
        return {"best_return": self.best}
