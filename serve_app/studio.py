"""The studio as replicas see it: another deployment of the same application, called by handle, which plays games."""

from typing import Protocol

from ray.serve.handle import DeploymentHandle


class Studio(Protocol):
    """What may be asked of it."""

    def look(self) -> None:
        """There is something new in the registry. Waits for nobody: the studio looks now and then by itself."""


class StudioHandle:
    """The studio behind Ray Serve's handle."""

    def __init__(self, handle: DeploymentHandle) -> None:
        self._handle = handle

    def look(self) -> None:
        """Tell it. If it is not there just now, it will see what there is when it is."""
        self._handle.look.remote()
