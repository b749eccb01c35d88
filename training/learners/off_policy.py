"""What learners share that are given samples of replay buffers: networks, their targets, gradient steps, metrics.

A subclass says which losses samples have (`losses`), and, where there are mixers or critics, which networks there are
besides the policies' (`extra_networks`). What takes several backward passes overrides `learn`, by `descend`, `follow`
and `note`.
"""

import copy
import logging
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner import DEFAULT_OPTIMIZER
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.utils.metrics import WEIGHTS_SEQ_NO
from torch import Tensor, nn

from league.config import LeagueConfig
from league.errors import ConfigError
from league.interface import Interface
from league.training_config import OffPolicyConfig
from training.replay import Sample
from training.sampling.env_runner import INTERFACE, LEAGUE

logger = logging.getLogger(__name__)

OFF_POLICY = "off_policy"
"""The learner's own part of its state: a component's name for RLlib."""


@dataclass(frozen=True, slots=True)
class Batch:
    """A sample on the learner's device. rows: column → (k, …), as training/sampling/closed.py and Replay name them."""

    rows: dict[str, Tensor]
    weights: Tensor


@dataclass(frozen=True, slots=True)
class Loss:
    """What a buffer's sample comes to.

    total: a scalar, whose gradient the optimisers of `networks` take. errors: (k,) |TD error|, or what else priorities
    are made of. statistics: curve → scalar; see training/curves.py.
    """

    total: Tensor
    errors: Tensor
    networks: tuple[str, ...]
    statistics: dict[str, Tensor] = field(default_factory=dict)


class OffPolicyLearner(TorchLearner):
    """`networks`: policy id → its module, and the extra ones by their names; Adam for each. `targets`: as they are,
    some gradient steps ago, without gradients."""

    settings: OffPolicyConfig
    interface: Interface

    def losses(self, batches: Mapping[str, Batch], learning: Collection[str]) -> dict[str, Loss]:
        """Buffer's key → the loss of its sample. learning: the policies that learn now."""
        raise NotImplementedError

    def extra_networks(self) -> dict[str, nn.Module]:
        """Mixers or critics, by names that are no policy ids. Called once, when the policies' modules are built."""
        return {}

    def followed(self) -> Iterable[str]:
        """The networks that have a target; by default all."""
        return self.networks

    def build(self) -> None:
        """Raises ConfigError where a GPU is asked for and there is none."""
        if self.config.num_gpus_per_learner and not torch.cuda.is_available():
            raise ConfigError(
                f"training.gpus: {self.config.num_gpus_per_learner:g} asked for the learner, but torch sees no GPU here"
            )
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, OffPolicyConfig)
        self.settings = settings
        self.interface = Interface.model_validate(self.config.env_config[INTERFACE])
        self.updates = 0
        self._statistics: dict[str, dict[str, list[Tensor]]] = defaultdict(lambda: defaultdict(list))
        super().build()

    def configure_optimizers(self) -> None:
        """Make the extra networks and the targets, and Adam for each network."""
        self.networks: dict[str, nn.Module] = dict(self.module.items())
        self.networks |= {name: network.to(self._device) for name, network in self.extra_networks().items()}
        self.targets = {name: copy.deepcopy(self.networks[name]).requires_grad_(False) for name in self.followed()}
        self._parameters: dict[str, list[nn.Parameter]] = {}
        for name, network in self.networks.items():
            parameters = list(network.parameters())
            optimizer = torch.optim.Adam(parameters, lr=self.learning_rate(name), fused=True)
            self.register_optimizer(module_id=name, optimizer=optimizer, params=parameters)
            self._parameters[name] = parameters

    def configure_optimizers_for_module(self, module_id: str, config: AlgorithmConfig | None = None) -> None:
        """Only RLlib's `add_module` would call it."""
        raise NotImplementedError(f"the policies of a league are fixed: {module_id} cannot be added")

    def compute_loss_for_module(self, **_: Any) -> Tensor:
        """Only RLlib's own `update` would call it, which knows of no samples: see `learn`."""
        raise NotImplementedError("an off-policy learner learns from samples of its buffers")

    def learning_rate(self, name: str) -> float:  # noqa: ARG002  # of a subclass, critics may have another one
        """Of a network's optimiser."""
        return self.settings.lr

    def learn(self, samples: Mapping[str, Sample], learning: Collection[str]) -> dict[str, NDArray]:
        """One gradient step on the samples. Returns buffer's key → errors (k,), for its priorities."""
        losses = self.losses({key: self.batch(sample) for key, sample in samples.items()}, learning)
        networks = {name for loss in losses.values() for name in loss.networks}
        norms = self.descend(torch.stack([loss.total for loss in losses.values()]).sum(), networks)
        for key, loss in losses.items():
            self.note(key, loss=loss.total, gradient_norm=norms[loss.networks[0]], **loss.statistics)
        self.follow()
        return {key: loss.errors.detach().cpu().numpy() for key, loss in losses.items()}

    def batch(self, sample: Sample) -> Batch:
        """A sample on the learner's device."""
        rows = {name: torch.from_numpy(column).to(self._device) for name, column in sample.rows.items()}
        return Batch(rows, torch.from_numpy(sample.weights).to(self._device))

    def descend(self, loss: Tensor, networks: Collection[str]) -> dict[str, Tensor]:
        """One step of these networks' optimisers, each gradient clipped by its global norm; a gradient that is not
        finite is dropped. Returns network → the norm."""
        names = [name for name in self.networks if name in networks]
        parameters = [parameter for name in names for parameter in self._parameters[name]]
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        norms = {}
        for name in names:
            norms[name] = nn.utils.clip_grad_norm_(self._parameters[name], self.settings.grad_clip)
            if torch.isfinite(norms[name]):
                self._named_optimizers[f"{name}_{DEFAULT_OPTIMIZER}"].step()
            else:
                logger.warning("Dropped a gradient of %s that is not finite.", name)
        return norms

    @torch.no_grad()
    def follow(self) -> None:
        """Count a gradient step, and move the targets where it is time: θ' ← θ' + rate (θ − θ')."""
        self.updates += 1
        self._weights_seq_no = self.updates
        if self.updates % self.settings.target_every:
            return
        for name, target in self.targets.items():
            network, rate = self.networks[name], self.settings.target_rate
            for old, new in zip(target.parameters(), network.parameters(), strict=True):
                old.lerp_(new, rate)
            for kept, known in zip(target.buffers(), network.buffers(), strict=True):
                kept.copy_(known)

    def note(self, key: str, **statistics: Tensor) -> None:
        """Take scalars of a gradient step into the means that are reported. key: a policy id, or a buffer's key."""
        for name, value in statistics.items():
            self._statistics[key][name].append(value.detach())

    def results(self) -> dict[str, Any]:
        """Buffer's key → means over the gradient steps since the last call; those that did not learn are left out."""
        noted, self._statistics = self._statistics, defaultdict(lambda: defaultdict(list))
        for key, statistics in noted.items():
            means = {name: float(torch.stack(values).mean()) for name, values in statistics.items()}
            self.metrics.log_dict(means, key=key, window=1)
        metrics = self.metrics.reduce()
        return {key: metrics[key] for key in noted}

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """As RLlib's, with the targets, the extra networks, and the count of gradient steps."""
        state: dict[str, Any] = super().get_state(components, not_components=not_components, **kwargs)
        if self._check_component(OFF_POLICY, components, not_components):
            state[OFF_POLICY] = {
                "updates": self.updates,
                "targets": {name: target.state_dict() for name, target in self.targets.items()},
                "extra": {n: net.state_dict() for n, net in self.networks.items() if n not in self.module},
            }
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        if own := state.get(OFF_POLICY):
            self.updates = own["updates"]
            for name, weights in own["targets"].items():
                self.targets[name].load_state_dict(weights)
            for name, weights in own["extra"].items():
                self.networks[name].load_state_dict(weights)
        # What is handed out must be newer than what runners have, also right after a restore.
        self._weights_seq_no = max(self._weights_seq_no, state.get(WEIGHTS_SEQ_NO, 0))

    def _log_trainable_parameters(self) -> None:
        """RLlib logs the numbers once, and NaN at every later update, also for policies that rest."""
