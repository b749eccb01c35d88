"""PPO in one compiled JAX program, in the style of PureJaxRL: `python jax_ppo.py NETWORK ENVIRONMENTS STEPS MINIBATCH`.

Connect four by pgx, one network for both players. Environments, networks and updates are one `jit` of `scan`s. For each
line of its standard input, a number of seconds, it prints the actions per second of processor time, not of compiling.
Runs in an environment of its own, with jax and pgx, and imports nothing of the project.
"""

import os
import sys
import time
from itertools import pairwise
from typing import Any, NamedTuple

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

import jax
import jax.numpy as jnp
import pgx
from pgx.experimental.wrappers import auto_reset

EPOCHS, GAMMA, LAMBDA, CLIP, ENTROPY, VALUE, LR, MAX_NORM = 4, 0.99, 0.95, 0.2, 0.05, 0.5, 5e-4, 0.5
ACTIONS, MASKED = 7, -1e9
CONVOLUTIONS = ((4, 2, 128), (1, 128, 32))
"""(kernel, channels, filters)."""
WIDTHS = {"mlp": (84, 256, 256), "convolutional": (384, 256)}
"""Inputs of the dense layers, and their units."""


class Transition(NamedTuple):
    """The columns of a step: boards, masks, actions, probabilities, values, rewards, and whether the game ended."""

    board: Any
    mask: Any
    action: Any
    log_p: Any
    value: Any
    reward: Any
    done: Any


def initial_parameters(network: str, key: Any) -> dict[str, Any]:
    """Orthogonal weights, a nearly uniform policy."""
    keys = iter(jax.random.split(key, 8))
    widths, scale = WIDTHS[network], jax.nn.initializers.orthogonal
    dense = [(scale(2**0.5)(next(keys), (inputs, units)), jnp.zeros(units)) for inputs, units in pairwise(widths)]
    convolutions = [
        (scale(2**0.5)(next(keys), (kernel, kernel, channels, filters)), jnp.zeros(filters))
        for kernel, channels, filters in (CONVOLUTIONS if network == "convolutional" else ())
    ]
    policy, value = (scale(0.01)(next(keys), (widths[-1], ACTIONS)), scale(1.0)(next(keys), (widths[-1], 1)))
    return {
        "convolutions": convolutions,
        "dense": dense,
        "policy": (policy, jnp.zeros(ACTIONS)),
        "value": (value, jnp.zeros(1)),
    }


def apply(parameters: dict[str, Any], board: Any, mask: Any) -> tuple[Any, Any]:
    """Log-probabilities (k, 7) and values (k,)."""
    hidden = board.astype(jnp.float32)
    for weight, bias in parameters["convolutions"]:
        # A product of patches: XLA's convolutions take ten times as long on the CPU.
        kernel = len(weight)
        height, width = hidden.shape[1] - kernel + 1, hidden.shape[2] - kernel + 1
        shifted = [hidden[:, y : y + height, x : x + width] for y in range(kernel) for x in range(kernel)]
        hidden = jax.nn.relu(jnp.concatenate(shifted, -1) @ weight.reshape(-1, weight.shape[-1]) + bias)
    hidden = hidden.reshape(len(board), -1)
    for weight, bias in parameters["dense"]:
        hidden = jax.nn.relu(hidden @ weight + bias)
    (policy, policy_bias), (value, value_bias) = parameters["policy"], parameters["value"]
    logits = jnp.where(mask, hidden @ policy + policy_bias, MASKED)
    return jax.nn.log_softmax(logits), (hidden @ value + value_bias)[:, 0]


def loss(parameters: dict[str, Any], steps: Transition, advantages: Any, targets: Any) -> Any:
    """The clipped surrogate loss."""
    log_p, values = apply(parameters, steps.board, steps.mask)
    ratio = jnp.exp(jnp.take_along_axis(log_p, steps.action[:, None], 1)[:, 0] - steps.log_p)
    policy = -jnp.minimum(ratio * advantages, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantages).mean()
    entropy = -(jnp.exp(log_p) * log_p).sum(-1).mean()
    return policy + VALUE * jnp.square(values - targets).mean() - ENTROPY * entropy


def adam(parameters: Any, moments: Any, gradient: Any) -> tuple[Any, Any]:
    """A step of Adam on the gradient clipped by its global norm."""
    first, second, count = moments
    norm = jnp.sqrt(sum(jnp.square(leaf).sum() for leaf in jax.tree.leaves(gradient)))
    factor, count = jnp.minimum(1.0, MAX_NORM / norm), count + 1
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * factor * g, first, gradient)
    second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * jnp.square(factor * g), second, gradient)
    rate = LR / (1 - 0.9**count)

    def moved(parameter: Any, m: Any, v: Any) -> Any:
        return parameter - rate * m / (jnp.sqrt(v / (1 - 0.999**count)) + 1e-5)

    return jax.tree.map(moved, parameters, first, second), (first, second, count)


def program(network: str, environments: int, steps: int, minibatch: int) -> tuple[Any, Any]:
    """The first state of a training, and the compiled iteration: state → state."""
    game = pgx.make("connect_four")
    play = jax.vmap(auto_reset(game.step, game.init))

    def step(carry: Any, key: Any) -> tuple[Any, Transition]:
        parameters, state = carry
        board, mask, player = state.observation, state.legal_action_mask, state.current_player
        log_p, value = apply(parameters, board, mask)
        choice, chance = jax.random.split(key)
        action = jax.random.categorical(choice, log_p)
        after = play(state, action, jax.random.split(chance, environments))
        reward = jnp.take_along_axis(after.rewards, player[:, None], 1)[:, 0]
        action_log_p = jnp.take_along_axis(log_p, action[:, None], 1)[:, 0]
        done = after.terminated | after.truncated
        return (parameters, after), Transition(board, mask, action, action_log_p, value, reward, done)

    def gae(following: Any, step: Transition) -> tuple[Any, Any]:
        # The value and the advantage of the next step are those of the other player.
        advantage, value = following
        delta = step.reward - GAMMA * value * ~step.done - step.value
        advantage = delta - GAMMA * LAMBDA * advantage * ~step.done
        return (advantage, step.value), advantage

    def gradient_step(carry: Any, rows: Any) -> tuple[Any, None]:
        return adam(*carry, jax.grad(loss)(carry[0], *rows)), None

    @jax.jit
    def iteration(training: Any) -> Any:
        parameters, moments, state, key = training
        key, sample_key, order_key = jax.random.split(key, 3)
        (_, state), sampled = jax.lax.scan(step, (parameters, state), jax.random.split(sample_key, steps))
        _, value = apply(parameters, state.observation, state.legal_action_mask)
        _, advantages = jax.lax.scan(gae, (jnp.zeros_like(value), value), sampled, reverse=True)
        targets = advantages + sampled.value
        standard = (advantages - advantages.mean()) / (advantages.std() + 1e-4)
        rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (sampled, standard, targets))

        def epoch(carry: Any, key: Any) -> tuple[Any, None]:
            order = jax.random.permutation(key, environments * steps)
            drawn = jax.tree.map(lambda leaf: leaf[order].reshape(-1, minibatch, *leaf.shape[1:]), rows)
            return jax.lax.scan(gradient_step, carry, drawn)

        (parameters, moments), _ = jax.lax.scan(epoch, (parameters, moments), jax.random.split(order_key, EPOCHS))
        return parameters, moments, state, key

    key = jax.random.key(0)
    parameters = initial_parameters(network, key)
    zeros = jax.tree.map(jnp.zeros_like, parameters)
    state = jax.jit(jax.vmap(game.init))(jax.random.split(key, environments))
    return (parameters, (zeros, zeros, 0), state, key), iteration


def main() -> None:
    """Measure on request."""
    network, *sizes = sys.argv[1:]
    environments, steps, minibatch = map(int, sizes)
    training, iteration = program(network, environments, steps, minibatch)
    for _ in range(2):  # the second one has the types of results, and is compiled again
        training = jax.block_until_ready(iteration(training))
    for line in sys.stdin:
        actions, began = 0, time.process_time()
        while (elapsed := time.process_time() - began) < float(line):
            training = jax.block_until_ready(iteration(training))
            actions += environments * steps
        print(actions / elapsed, flush=True)


if __name__ == "__main__":
    main()
