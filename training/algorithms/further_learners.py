"""The learners besides the first, each in a process of its own, which is an actor of Ray.

The first learner is in the algorithm's process. Before each update, the others receive its state and the sample, so
that they need no state of their own: checkpoints contain that of the first, and a run can be resumed with any number.
"""

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import ray
import torch
import torch.distributed
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core import COMPONENT_METRICS_LOGGER

from training.learners.ppo import PPOLearner
from training.learners.ranks import LearnerLost, Rank, TCPStore, connect
from training.rllib_compat import TrainingData
from training.sampling.episode_chunks import EpisodeChunks

LOSS_SECONDS = 60.0
"""Time in which Ray reports that a process ended, after its connections were closed."""


class FurtherLearner:
    """A learner that repeats the updates of the first one, on its share of each minibatch."""

    def __init__(self, config: AlgorithmConfig, index: int) -> None:
        """config: of the algorithm. index: among the learners, from 1."""
        logging.disable(logging.WARNING)  # the first learner logs the same
        self._index = index
        self._learner: PPOLearner = config.learner_class(config=config, module_spec=config.rl_module_spec)
        self._learner.build()

    def connect(self, address: str, port: int, count: int, backend: str) -> None:
        """Connect with the other learners. address, port: of the first one's store. count: of all learners."""
        self._learner.rank = Rank(self._index, count)
        connect(self._learner.rank, TCPStore(address, port, count), backend)

    def update(self, request: dict[str, Any]) -> None:
        """Take part in an update. request: the state to start from, and the arguments of the learner's update."""
        torch.set_rng_state(request["random_state"])
        self._learner.weights_version = -1  # RLlib loads newer weights only
        self._learner.set_state(request["state"])
        self._learner.update(training_data=TrainingData(episodes=request["episodes"]), **request["arguments"])

    def apply(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function in this process, with this object as its first argument."""
        return function(self, *args)


class FurtherLearners:
    """Starts the processes, and lets them take part in each update of the first learner."""

    def __init__(self, config: AlgorithmConfig, count: int) -> None:
        """config: of the algorithm, in which a learner has the CPUs of a runner. count: of all learners."""
        self._gpus = config.num_gpus_per_learner
        actor = ray.remote(num_cpus=config.num_cpus_per_env_runner, num_gpus=self._gpus)(FurtherLearner)
        self._actors: list[Any] = [actor.remote(config, index) for index in range(1, count)]

    def connect(self, first: PPOLearner) -> None:
        """Connect the processes with the first learner, once they have started."""
        self._first = first
        if not self._actors:
            return
        ray.get([actor.__ray_ready__.remote() for actor in self._actors])
        count, backend = 1 + len(self._actors), "nccl" if self._gpus >= 1 else "gloo"
        address = ray.util.get_node_ip_address()
        # Torch would listen on all interfaces.
        listener = socket.create_server((address, 0))
        port = listener.getsockname()[1]
        store = TCPStore(
            address, port, count, is_master=True, wait_for_workers=False, master_listen_fd=listener.detach()
        )
        connected = [actor.connect.remote(address, port, count, backend) for actor in self._actors]
        first.rank = Rank(0, count)
        try:
            connect(first.rank, store, backend)
        finally:
            ray.get(connected)

    def apply(self, function: Callable[..., Any], *args: Any) -> list[Any]:
        """Call a function in each process, with its FurtherLearner as first argument; return the results."""
        return ray.get([actor.apply.remote(function, *args) for actor in self._actors])

    @contextmanager
    def updating(self, episodes: Sequence[EpisodeChunks], **arguments: Any) -> Iterator[None]:
        """Let all take part in the update that the first learner makes inside, with the same arguments.

        Raises RayActorError if one is lost, and the exception of one that fails. No further update is possible then.
        """
        if not self._actors:
            yield
            return
        request = ray.put(
            {
                "random_state": torch.get_rng_state(),
                "state": self._first.get_state(not_components=COMPONENT_METRICS_LOGGER),
                "episodes": episodes,
                "arguments": arguments,
            }
        )
        updates = [actor.update.remote(request) for actor in self._actors]
        with ThreadPoolExecutor(1) as executor:
            completion = executor.submit(self._await, updates)
            try:
                yield
            except LearnerLost:
                completion.result(LOSS_SECONDS)
                raise
            except BaseException:
                self._kill()
                raise
            completion.result()

    def end(self) -> None:
        """End the processes and the connections."""
        self._kill()
        if self._actors and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()

    def _kill(self) -> None:
        for actor in self._actors:
            ray.kill(actor)

    def _await(self, updates: list[Any]) -> None:
        """Wait for the updates. If one fails, end all processes, which ends the update of the first learner, too."""
        lost = None
        while updates:
            (update,), updates = ray.wait(updates)
            try:
                ray.get(update)
            except LearnerLost as error:
                lost = error  # the consequence of a failure elsewhere, which is the error to raise
            except Exception:
                self._kill()
                if (group := torch.distributed.group.WORLD) is not None:
                    group.abort()  # NCCL does not notice that processes have ended
                raise
        if lost is not None:
            raise lost
