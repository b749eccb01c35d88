"""Base of the learners that sample from replay buffers: targets of Q-learning, and target networks.

A subclass implements `losses`, and `extra_networks` if it has mixers or critics. One with several backward passes
overrides `step`, using `gradient_step` and `log_statistics`. Steps do not wait for a GPU: they read no values of
tensors, and no shape depends on them.
"""

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from ray.rllib.utils.metrics import WEIGHTS_SEQ_NO
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from league.config.league import LeagueConfig
from league.config.off_policy import OffPolicyConfig
from league.interface import Interface
from training.learners.optimizer import ClippedAdam, check_gradients
from training.learners.processor import keep_memory
from training.modules.policy_module import MASKED_LOGIT
from training.replay_buffer import Sample
from training.rllib_compat import FixedPoliciesLearner, includes_component
from training.sampling.env_runner import INTERFACE, LEAGUE


def best_legal_action(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return the action (B,) with the highest of the values (B, n) that the mask (B, n) allows.

    If the mask allows no action, as in the last observations of some environments, all actions count.
    """
    if mask is None:
        return values.argmax(-1)
    allowed = mask.bool()
    allowed = allowed | ~allowed.any(-1, keepdim=True)
    return torch.where(allowed, values, MASKED_LOGIT).argmax(-1)


def next_actions(online: Tensor | None, target: Tensor, mask: Tensor | None) -> Tensor:
    """Return the actions (B,) whose target values are bootstrapped from.

    In double Q-learning, the online network selects them (van Hasselt, Guez and Silver, 2016, arXiv 1509.06461,
    equation 4), otherwise the target network does (online: None).
    """
    return best_legal_action(target if online is None else online, mask)


def bootstrapped_returns(rewards: Tensor, discounts: Tensor, terminated: Tensor, next_values: Tensor) -> Tensor:
    """Return R + γ^m V(s_{t+m}), without bootstrap after termination, with it after truncation.

    All arguments are (B,): sums of the m discounted rewards, γ^m, termination of the last step, values after it.
    """
    return rewards + discounts * torch.where(terminated, 0.0, next_values)


def project_distribution(
    probabilities: Tensor, atoms: Tensor, rewards: Tensor, discounts: Tensor, terminated: Tensor
) -> Tensor:
    """Project the distribution of R + γ^m Z onto the atoms of Z.

    Bellemare, Dabney and Munos, 2017, arXiv 1707.06887, algorithm 1. The mass of a return between two atoms is divided
    between them in proportion to proximity; beyond the outermost atoms, it goes to them.

    Args:
        probabilities: (B, atoms), of the selected next actions.
        atoms: (atoms,), evenly spaced.
        rewards: (B,), sums of the m discounted rewards.
        discounts: (B,), γ^m.
        terminated: (B,), of the last step.

    Returns:
        (B, atoms).
    """
    count = len(atoms)
    low, high = atoms[0], atoms[-1]
    moved = bootstrapped_returns(
        rewards.unsqueeze(1), discounts.unsqueeze(1), terminated.unsqueeze(1), atoms.unsqueeze(0)
    )
    places = (moved.clamp(low, high) - low) / (high - low) * (count - 1)
    # Share of an atom's mass that another one gets: 1 at its own place, falling to 0 at its neighbours'.
    numbers = torch.arange(count, device=atoms.device, dtype=places.dtype)
    shares = (1 - (places.unsqueeze(1) - numbers.view(1, -1, 1)).abs()).clamp(min=0)
    return (shares * probabilities.unsqueeze(1)).sum(-1)


OFF_POLICY = "off_policy"
"""The component of the learner's state that RLlib does not know."""


@dataclass(frozen=True, slots=True)
class ReplayBatch:
    """A sample on the learner's device.

    rows: column → (k, …), named as in training/sampling/closed_transitions.py and ReplayBuffer. weights: (k,) float32.
    """

    rows: dict[str, Tensor]
    weights: Tensor

    def split(self, parts: int) -> list["ReplayBatch"]:
        """Divide the rows equally."""
        rows = {name: column.chunk(parts) for name, column in self.rows.items()}
        return [
            ReplayBatch({name: columns[part] for name, columns in rows.items()}, weights)
            for part, weights in enumerate(self.weights.chunk(parts))
        ]


@dataclass(frozen=True, slots=True)
class ReplayLoss:
    """The loss on a buffer's sample.

    total: a scalar, whose gradient updates `networks`. errors: (k,), |TD error| or another measure for priorities.
    statistics: metric → scalar; see training/algorithms/metrics.py.
    """

    total: Tensor
    errors: Tensor
    networks: tuple[str, ...]
    statistics: dict[str, Tensor] = field(default_factory=dict)


class OffPolicyLearner(FixedPoliciesLearner):
    """A learner with target networks and one Adam optimiser per network.

    `networks`: policy id → its module, and extra networks by name. `targets`: delayed copies without gradients.
    """

    settings: OffPolicyConfig
    interface: Interface

    def losses(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, ReplayLoss]:
        """Return buffer key → loss of its sample. learning: the policies that currently learn."""
        raise NotImplementedError

    def extra_networks(self) -> dict[str, nn.Module]:
        """Return mixers or critics by name, different from all policy ids. Called once, after the modules are built."""
        return {}

    def build(self) -> None:
        settings = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).training
        assert isinstance(settings, OffPolicyConfig)
        self.settings = settings
        self.interface = Interface.model_validate(self.config.env_config[INTERFACE])
        self.updates = 0
        keep_memory()
        # Key → names of statistics, and their sums over gradient steps with the number of these.
        self._statistics: dict[str, tuple[tuple[str, ...], Tensor]] = {}
        super().build()
        self._one = torch.ones((), device=self.device)

    def configure_optimizers(self) -> None:
        """Create the extra networks, the targets, and the optimisers."""
        self.networks: dict[str, nn.Module] = dict(self.module.items())
        self.networks |= {name: network.to(self.device) for name, network in self.extra_networks().items()}
        self.targets = {name: copy.deepcopy(net).requires_grad_(False) for name, net in self.networks.items()}
        self._optimizers: dict[str, ClippedAdam] = {}
        self._parameters = {name: list(network.parameters()) for name, network in self.networks.items()}
        for name, parameters in self._parameters.items():
            optimizer = ClippedAdam(parameters, lr=self.settings.lr, max_norm=self.settings.grad_clip)
            self.register_optimizer(module_id=name, optimizer=optimizer, params=parameters)
            self._optimizers[name] = optimizer
        self._target_parameters = [parameter for net in self.targets.values() for parameter in net.parameters()]
        self._target_buffers = [
            (old, new)
            for name, target in self.targets.items()
            for old, new in zip(target.buffers(), self.networks[name].buffers(), strict=True)
        ]
        self._interpolate = get_ema_multi_avg_fn(1 - self.settings.target_rate)

    def compute_loss_for_module(self, **_: Any) -> Tensor:
        """Raise NotImplementedError. RLlib calls this from its own `update` only; see `learn`."""
        raise NotImplementedError("off-policy learners learn from samples of replay buffers")

    def learn(self, samples: Mapping[str, Sample], learning: Collection[str], steps: int = 1) -> dict[str, Tensor]:
        """Take gradient steps, each on the next of as many equal parts of the samples, and update targets when due.

        Returns buffer key → |TD error| or another measure for the priorities of all rows, on the learner's device.
        """
        parts = {key: self.batch(sample).split(steps) for key, sample in samples.items()}
        errors = []
        for number in range(steps):
            errors.append(self.step({key: batches[number] for key, batches in parts.items()}, learning))
            self.update_targets()
        return {key: torch.cat([of_step[key] for of_step in errors]) for key in samples}

    def step(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, Tensor]:
        """Take one gradient step. Returns buffer key → errors (k,)."""
        losses = self.losses(batches, learning)
        networks = {name for loss in losses.values() for name in loss.networks}
        norms = self.gradient_step(torch.stack([loss.total for loss in losses.values()]).sum(), networks)
        for key, loss in losses.items():
            self.log_statistics(key, loss=loss.total, gradient_norm=norms[loss.networks[0]], **loss.statistics)
        return {key: loss.errors.detach() for key, loss in losses.items()}

    def batch(self, sample: Sample) -> ReplayBatch:
        """Move a sample to the learner's device."""
        rows = {name: torch.from_numpy(column).to(self.device) for name, column in sample.rows.items()}
        return ReplayBatch(rows, torch.from_numpy(sample.weights).to(self.device))

    def gradient_step(self, loss: Tensor, networks: Collection[str]) -> dict[str, Tensor]:
        """Step the optimisers of `networks`, with each gradient clipped by its global norm.

        Gradients that are not finite are dropped. Returns network → gradient norm.
        """
        names = [name for name in self.networks if name in networks]
        parameters = [parameter for name in names for parameter in self._parameters[name]]
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        return {name: self._optimizers[name].clip_and_step() for name in names}

    @torch.no_grad()
    def update_targets(self) -> None:
        """Count a gradient step, and update the targets when due: θ' ← θ' + rate (θ − θ')."""
        self.updates += 1
        self.weights_version = self.updates
        if self.updates % self.settings.target_every:
            return
        parameters = [parameter for network in self._parameters.values() for parameter in network]
        self._interpolate(self._target_parameters, parameters, None)
        for old, new in self._target_buffers:
            old.copy_(new)

    def log_statistics(self, key: str, **statistics: Tensor) -> None:
        """Add scalars of a gradient step to the reported means. key: a policy id or a buffer key."""
        row = torch.stack([*statistics.values(), self._one]).detach()
        if key in self._statistics:
            self._statistics[key][1].add_(row)
        else:
            self._statistics[key] = tuple(statistics), row

    def results(self) -> dict[str, Any]:
        """Return buffer key → means over the gradient steps since the last call, for those that learned."""
        learned = []
        for key, (names, sums) in self._statistics.items():
            *totals, steps = sums.tolist()
            if steps:
                means = {name: total / steps for name, total in zip(names, totals, strict=True)}
                self.metrics.log_dict(means, key=key, window=1)
                learned.append(key)
            sums.zero_()
        check_gradients(self._optimizers)
        metrics = self.metrics.reduce()
        return {key: metrics[key] for key in learned}

    def get_state(
        self,
        components: str | Collection[str] | None = None,
        *,
        not_components: str | Collection[str] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Return RLlib's state with the targets, the extra networks, and the number of gradient steps."""
        state: dict[str, Any] = super().get_state(components, not_components=not_components, **kwargs)
        if includes_component(self, OFF_POLICY, components, not_components):
            state[OFF_POLICY] = {
                "updates": self.updates,
                "targets": {name: target.state_dict() for name, target in self.targets.items()},
                "extra": {n: net.state_dict() for n, net in self.networks.items() if n not in self.module},
            }
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        super().set_state(state)
        if off_policy_state := state.get(OFF_POLICY):
            self.updates = off_policy_state["updates"]
            for name, weights in off_policy_state["targets"].items():
                self.targets[name].load_state_dict(weights)
            for name, weights in off_policy_state["extra"].items():
                self.networks[name].load_state_dict(weights)
        for name in self.networks:
            # The saved state of an optimiser contains the learning rate of that time.
            self.get_optimizer(module_id=name).param_groups[0]["lr"] = self.settings.lr
        # The next weights must be newer than those of the runners, even right after a restore.
        self.weights_version = max(self.weights_version, state.get(WEIGHTS_SEQ_NO, 0))
