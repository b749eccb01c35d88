"""Probes: observations from play with the actions that a published graph took, which it must take wherever it runs.

A version's digests prove that its files are whole, not that this machine's runtime computes with them what the
publisher's did. So a graph answers its probes before it may serve. Probes are an .npz archive of plain arrays: nothing
in it can run.
"""

import io
import zipfile
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from league.errors import ArtifactCorrupt, ObservationError
from league.policies.agreement import excused
from league.policies.onnx import ACTION, STATE_IN, OnnxPolicy
from league.spaces import Space

LARGEST = 256 * 2**20
"""Bytes of an archive's arrays. A thousandth of that may be in the file."""


@dataclass(frozen=True, slots=True)
class Probes:
    """k situations of a policy with its greedy actions.

    observations: ONNX input name → (k, …). state: `state_in_<i>` → (k, width), empty without a memory.
    actions: (k, *action shape), in the agent's own action space.
    """

    observations: dict[str, NDArray]
    state: dict[str, NDArray]
    actions: NDArray

    def __len__(self) -> int:
        return len(self.actions)

    def to_bytes(self) -> bytes:
        """The .npz archive."""
        archive = io.BytesIO()
        arrays: dict[str, NDArray] = {**self.observations, **self.state, ACTION: self.actions}
        np.savez_compressed(archive, allow_pickle=False, **arrays)
        return archive.getvalue()

    @classmethod
    def from_bytes(cls, archive: bytes, source: str) -> Self:
        """Read an archive. `source` names it in the ArtifactCorrupt that a wrong one raises."""
        try:
            with zipfile.ZipFile(io.BytesIO(archive)) as listed:
                size = sum(entry.file_size for entry in listed.infolist())
            if size > LARGEST:
                raise ValueError(f"{size} bytes when they are decompressed, expected at most {LARGEST}")
            with np.load(io.BytesIO(archive), allow_pickle=False) as file:
                arrays: dict[str, NDArray] = {name: file[name] for name in file.files}
            if strangers := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
                raise ValueError(f"{strangers[0]} is no array")
            actions = arrays.pop(ACTION)
        except Exception as error:  # whatever zipfile, its decompressors and NumPy make of bytes that are none
            raise ArtifactCorrupt(f"{source} holds no probes: {' '.join(str(error).split())}") from error
        if (
            not actions.ndim
            or not len(actions)
            or any(array.shape[:1] != actions.shape[:1] for array in arrays.values())
        ):
            raise ArtifactCorrupt(f"{source} holds no probes: its arrays differ in length")
        state = {name: array for name, array in arrays.items() if name.startswith(STATE_IN)}
        return cls({name: array for name, array in arrays.items() if name not in state}, state, actions)

    def check(self, policy: OnnxPolicy, space: Space, source: str) -> None:
        """Let `policy`, whose actions are of `space`, answer. Raises ArtifactCorrupt if one answer is another.

        Where the two best logits are closer than agreement.NEAR_TIE, either action will do.
        """
        try:
            answer = policy.distribution(self.observations, state=self.state or None)
        except ObservationError as error:
            raise ArtifactCorrupt(f"{source} does not fit the graph: {error}") from error
        assert answer.dist_inputs is not None
        if answer.actions.shape != self.actions.shape:
            shapes = f"{list(answer.actions.shape)}, expected {list(self.actions.shape)}"
            raise ArtifactCorrupt(f"the graph answers the probes of {source} with actions {shapes}")
        right = excused(answer.actions, self.actions, answer.dist_inputs, space)
        if not right.all():
            raise ArtifactCorrupt(
                f"the graph answers {int((~right).sum())} of {len(self)} probe observations of {source}"
                " otherwise than when it was published"
            )
