"""A search of one position of connect four in plain Python: how little a simulation needs to cost.

PUCT with first-play urgency, on bit boards; eight leaves, gathered by virtual loss, are evaluated in one call of the
network, and backed up with a discount. It knows one game, takes the network's policy only, and has no limit of time.
"""

import math

import numpy as np
from onnxruntime import InferenceSession

from league.environments.vector.connect_four import COLUMNS, ROWS, STRIDE

LEAVES, EXPLORATION, REDUCTION, DISCOUNT = 8, 1.5, 0.2, 0.95
BOTTOM = sum(1 << STRIDE * column for column in range(COLUMNS))
FULL = BOTTOM * (2**ROWS - 1)
BY_COLUMN = [(2**ROWS - 1) << STRIDE * column for column in range(COLUMNS)]
SQUARES = [STRIDE * column + row for row in reversed(range(ROWS)) for column in range(COLUMNS)]


class Node:
    """The pieces of the player that acts, and of the other one."""

    __slots__ = ("children", "count", "mine", "outcome", "priors", "theirs", "values", "visits")

    def __init__(self, mine: int, theirs: int) -> None:
        self.mine, self.theirs = mine, theirs
        self.visits, self.values, self.count = [0] * COLUMNS, [0.0] * COLUMNS, 0
        self.children: list[Node | None] = [None] * COLUMNS
        self.priors: list[float] | None = None
        self.outcome = -1.0 if _has_four(theirs) else 0.0 if (mine | theirs) == FULL else None


def plain_search(session: InferenceSession, simulations: int) -> list[int]:
    """Search from the empty board, and return the visits of the columns."""
    root, done = Node(0, 0), 0
    _evaluate([root], session)
    while done < simulations:
        reached = [_descend(root) for _ in range(min(LEAVES, simulations - done))]
        done += len(reached)
        if leaves := {id(leaf): leaf for leaf, _ in reached if leaf.outcome is None}:
            _evaluate(list(leaves.values()), session)
        for leaf, path in reached:
            value = leaf.outcome or 0.0
            for node, column in reversed(path):
                value *= -DISCOUNT
                node.values[column] += value + 1.0  # returns the virtual loss
    return root.visits


def _has_four(pieces: int) -> bool:
    for distance in (1, STRIDE - 1, STRIDE, STRIDE + 1):
        pairs = pieces & pieces >> distance
        if pairs & pairs >> 2 * distance:
            return True
    return False


def _descend(root: Node) -> tuple[Node, list[tuple[Node, int]]]:
    node, path = root, list[tuple[Node, int]]()
    while node.priors is not None:
        urgency, best, column = EXPLORATION * math.sqrt(node.count + 1), -math.inf, 0
        for move, prior in enumerate(node.priors):
            if prior:
                visits = node.visits[move]
                score = node.values[move] / visits if visits else -REDUCTION
                score += urgency * prior / (1 + visits)
                if score > best:
                    best, column = score, move
        path.append((node, column))
        node.count += 1
        node.visits[column] += 1
        node.values[column] -= 1.0  # virtual loss
        child = node.children[column]
        if child is None:
            piece = ((node.mine | node.theirs) + BOTTOM) & BY_COLUMN[column]
            child = node.children[column] = Node(node.theirs, node.mine | piece)
        node = child
    return node, path


def _evaluate(nodes: list[Node], session: InferenceSession) -> None:
    boards = np.empty((len(nodes), ROWS * COLUMNS, 2), np.int8)
    boards[:, :, 0] = [[node.mine >> square & 1 for square in SQUARES] for node in nodes]
    boards[:, :, 1] = [[node.theirs >> square & 1 for square in SQUARES] for node in nodes]
    moves = [((node.mine | node.theirs) + BOTTOM) & FULL for node in nodes]
    masks = np.array([[bool(move & column) for column in BY_COLUMN] for move in moves], np.int8)
    feed = {"observation": boards.reshape(-1, ROWS, COLUMNS, 2), "action_mask": masks}
    (logits,) = session.run(["action_dist_inputs"], feed)
    for node, outputs, mask in zip(nodes, logits.tolist(), masks.tolist(), strict=True):
        highest = max(output for output, is_legal in zip(outputs, mask, strict=True) if is_legal)
        weights = [
            math.exp(output - highest) if is_legal else 0.0 for output, is_legal in zip(outputs, mask, strict=True)
        ]
        total = sum(weights)
        node.priors = [weight / total for weight in weights]
