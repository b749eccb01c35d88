"""Probes: recorded observations and greedy actions that a version must reproduce before it is served.

Digests prove that files are intact, but not that the runtime on this machine computes the same actions as the
publisher's. Probes verify that. They are stored as an .npz archive of plain arrays, which cannot execute code.
"""

import io
import zipfile
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from league.errors import ArtifactCorrupt, ObservationError, one_line
from league.policies.draws import elements
from league.policies.onnx import ACTION, STATE_IN, OnnxPolicy
from league.spaces import Box, MultiDiscrete, Space
from league.spaces.arrays import bounds

NEAR_TIE = 1e-5
"""Maximum difference of two logits whose order may depend on the runtime's order of summation."""
ACTION_TOLERANCE = 1e-4
"""Maximum difference of continuous actions, relative to the range of the bounds, or to 1 + |x| without bounds."""


def same(actions: NDArray, expected: NDArray, space: Space, tolerance: float = ACTION_TOLERANCE) -> NDArray[np.bool_]:
    """Return whether each of k actions is the expected one, (k,) bool. `tolerance` applies to Box spaces."""
    return np.logical_not(np.any(_differs(actions, expected, space, tolerance), axis=1))


def excused(actions: NDArray, expected: NDArray, dist_inputs: NDArray, space: Space) -> NDArray[np.bool_]:
    """Return whether each action is the expected one, or differs only in near ties of the best logits, (k,) bool.

    dist_inputs: inputs of the distribution of one of the two, (k, d).
    """
    differs = _differs(actions, expected, space, ACTION_TOLERANCE)
    if isinstance(space, Box):
        return np.logical_not(np.any(differs, axis=1))
    parts = elements(dist_inputs, space) if isinstance(space, MultiDiscrete) else [dist_inputs]
    margins = np.stack([_margin(logits) for logits in parts], axis=1)
    return np.logical_not(np.any(differs & (margins >= NEAR_TIE), axis=1))


def _differs(actions: NDArray, expected: NDArray, space: Space, tolerance: float) -> NDArray[np.bool_]:
    """Elementwise difference, (k, elements of an action) bool."""
    if isinstance(space, Box):
        low, high = bounds(space)
        size = np.abs(expected, dtype=np.float64)
        span = np.where(np.isfinite(low) & np.isfinite(high), high - low, 1 + size)
        # Equal outputs may be rounded to neighbouring numbers, which differ by more in float16.
        rounding = float(np.finfo(space.dtype).eps) * size
        differs = ~(np.abs(actions - expected) <= np.maximum(tolerance * span, rounding))
    else:
        differs = actions != expected
    return differs.reshape(len(actions), -1)


def _margin(logits: NDArray) -> NDArray:
    """Difference of the two largest logits of each row; infinite for a single action."""
    if logits.shape[-1] < 2:
        return np.full(len(logits), np.inf)
    ordered = np.sort(logits, axis=-1)
    return ordered[:, -1] - ordered[:, -2]


MAX_SIZE = 256 * 2**20
"""Maximum size of the decompressed arrays in bytes; archives can be compressed by a factor of 1000."""


@dataclass(frozen=True, slots=True)
class Probes:
    """k inputs of a policy with its greedy actions.

    Attributes:
        observations: ONNX input name → array (k, …).
        state: `state_in_<i>` → array (k, width); empty for policies without state.
        actions: Actions in the agent's action space, (k, *action shape).
    """

    observations: dict[str, NDArray]
    state: dict[str, NDArray]
    actions: NDArray

    def __len__(self) -> int:
        return len(self.actions)

    def to_bytes(self) -> bytes:
        """Serialize as an .npz archive."""
        archive = io.BytesIO()
        arrays: dict[str, NDArray] = {**self.observations, **self.state, ACTION: self.actions}
        np.savez_compressed(archive, allow_pickle=False, **arrays)
        return archive.getvalue()

    @classmethod
    def from_bytes(cls, archive: bytes, source: str) -> Self:
        """Parse an archive. `source` identifies it in error messages. Raises ArtifactCorrupt."""
        try:
            with zipfile.ZipFile(io.BytesIO(archive)) as listed:
                size = sum(entry.file_size for entry in listed.infolist())
            if size > MAX_SIZE:
                raise ValueError(f"{size} bytes after decompression, expected at most {MAX_SIZE}")
            with np.load(io.BytesIO(archive), allow_pickle=False) as file:
                arrays: dict[str, NDArray] = {name: file[name] for name in file.files}
            if invalid := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
                raise ValueError(f"{invalid[0]} is not an array")
            actions = arrays.pop(ACTION)
        except Exception as error:  # zipfile, its decompressors and NumPy raise many kinds for invalid bytes
            raise ArtifactCorrupt(f"{source} contains no probes: {one_line(error)}") from error
        if (
            not actions.ndim
            or not len(actions)
            or any(array.shape[:1] != actions.shape[:1] for array in arrays.values())
        ):
            raise ArtifactCorrupt(f"{source} contains no probes: its arrays differ in length")
        state = {name: array for name, array in arrays.items() if name.startswith(STATE_IN)}
        return cls({name: array for name, array in arrays.items() if name not in state}, state, actions)

    def check(self, policy: OnnxPolicy, space: Space, source: str) -> None:
        """Raise ArtifactCorrupt unless `policy` reproduces the actions, apart from near ties.

        space: action space of the policy. source: identifies the version in error messages.
        """
        try:
            answer = policy.outputs(self.observations, state=self.state or None)
        except ObservationError as error:
            raise ArtifactCorrupt(f"{source} does not fit the graph: {error}") from error
        assert answer.dist_inputs is not None
        if answer.actions.shape != self.actions.shape:
            shapes = f"{list(answer.actions.shape)}, expected {list(self.actions.shape)}"
            raise ArtifactCorrupt(f"the actions for the probes of {source} have shape {shapes}")
        right = excused(answer.actions, self.actions, answer.dist_inputs, space)
        if not right.all():
            raise ArtifactCorrupt(
                f"for {int((~right).sum())} of {len(self)} probe observations of {source} the graph chooses other"
                " actions than when it was published"
            )
