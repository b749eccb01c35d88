"""The policy of the frameworks that serve models: ONNX Runtime with one thread.

This module and the servers next to it that use it run in virtual environments without this project.
"""

from typing import Any

import numpy as np
import onnxruntime


class GraphPolicy:
    """A graph for boards (6, 7, 2) and masks (7,), int8."""

    def __init__(self, path: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def act(self, board: Any, mask: Any) -> int:
        """Return the best legal column of one board, as nested lists or arrays."""
        tensors = {
            "observation": np.asarray(board, np.int8).reshape(1, 6, 7, 2),
            "action_mask": np.asarray(mask, np.int8).reshape(1, 7),
        }
        (actions,) = self._session.run(["action"], tensors)
        return int(actions[0])
