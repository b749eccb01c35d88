"""The `environment` section, which each manifest repeats."""

from importlib.metadata import version
from typing import Any, Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from league.config.base import JSON, Part
from league.config.external import ExternalConfig
from league.environment_code import environment_code
from league.interface import digest


class WrapperConfig(Part):
    """A wrapper, in YAML `name` or `{name: {argument: value}}`. Wrappers are applied in order."""

    name: str
    """A wrapper of SuperSuit, or a PettingZoo wrapper of the user's code, `package.module:name`."""
    kwargs: JSON = Field(default={})

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"name": value}
        if isinstance(value, dict) and len(value) == 1 and "name" not in value:
            name, kwargs = next(iter(value.items()))
            return {"name": name, "kwargs": kwargs or {}}
        return value

    @property
    def is_own(self) -> bool:
        """Whether it is the user's code."""
        return ":" in self.name


ADAPTERS = {"openspiel": "league.environments.openspiel"}
"""Short entry points of adapters for other libraries → their modules."""
EXTERNAL = "external"
"""The entry point of games that run in simulators."""
IN_PYTHON = "{} is for games in Python: a simulator applies its own"
"""What is wrong with a setting of such a game."""


class EnvironmentConfig(Part):
    """An environment and its wrappers."""

    entry_point: str
    """A PettingZoo module (`pettingzoo.classic.connect_four_v3`), a function (`package.module:function`), or
    `openspiel` for a game of OpenSpiel. With `external`, which replaces it, `external`."""
    external: ExternalConfig | None = Field(default=None, exclude_if=lambda value: value is None)
    """A game that runs in simulators outside Python."""
    api: Literal["aec", "parallel", "rllib"] | None = None
    """PettingZoo's AEC or Parallel API, or RLlib's MultiAgentEnv. By default the API is detected: from the return value
    of a function; for a module, Parallel if it has `parallel_env`, else AEC."""
    kwargs: JSON = Field(default={})
    """Keyword arguments of the environment's constructor."""
    wrappers: tuple[WrapperConfig, ...] = ()
    vector: str | None = None
    """A faster implementation of the environment, `package.module:Class`, a subclass of
    league.environments.vector.vector_env.VectorEnv. Some environments of PettingZoo and MPE2 have one by default."""

    revision: str | None = None
    """Identifies the rules of the game. It replaces the digest of the source files, so that editing them does not start
    a new game. Change it with the rules, and with data files that the environment reads."""
    _folder: str | None = PrivateAttr(default=None)

    @model_validator(mode="before")
    @classmethod
    def _external_replaces_entry_point(cls, value: Any) -> Any:
        if isinstance(value, dict) and value.get(EXTERNAL) is not None:
            return {"entry_point": EXTERNAL, **value}
        return value

    @model_validator(mode="after")
    def _fits_external(self) -> Self:
        if (self.external is not None) != (self.entry_point == EXTERNAL):
            raise ValueError(
                "a game is either external or has another entry_point: expected environment.external without it"
            )
        if self.external is not None:
            self.refuse(("api", "kwargs", "wrappers", "vector", "revision"), IN_PYTHON)
        return self

    def search_in(self, folder: str | None) -> None:
        """Set `folder`, which is no part of the section, so that manifests do not contain a path of this machine."""
        self._folder = folder

    @property
    def resolved_entry_point(self) -> str:
        """The entry point, where the short name of an adapter is replaced by its module."""
        return ADAPTERS.get(self.entry_point, self.entry_point)

    def with_arguments(self, kwargs: JSON) -> Self:
        """Return the environment with other arguments of its constructor, besides those or in place of them."""
        return self.model_copy(update={"kwargs": self.kwargs | kwargs})

    def digest(self) -> str:
        """Return the SHA-256 of the settings. Versions only play in the environment that they were trained in.

        `vector` is no part of it, because it changes the speed only, nor are `revision`, which identifies the code, and
        what is only known about a simulator.
        """
        document = self.model_dump(mode="json", exclude={"vector", "revision"})
        if self.external is not None:
            document[EXTERNAL] = self.external.model_dump(mode="json", exclude={"answer_seconds", "deterministic"})
        return digest(document)

    @property
    def folder(self) -> str | None:
        """The folder in which entry points are searched first: that of the league."""
        return self._folder

    def has_code(self) -> bool:
        """Return whether the code of the environment is on this machine."""
        return self.external is not None or environment_code(self.resolved_entry_point, self.folder).exists

    def code(self) -> JSON:
        """Return what identifies the environment's code: revision or source digest, and the versions of libraries; of a
        game that runs in simulators, their name and version.
        """
        if self.external is not None:
            return {"environment.simulator": f"{self.external.simulator} {self.external.version}"}
        code = environment_code(self.resolved_entry_point, self.folder)
        identity: JSON = {"source": code.source} if self.revision is None else {"revision": self.revision}
        if self.revision is None:
            names = (wrapper.name for wrapper in self.wrappers if wrapper.is_own)
            identity |= {f"wrappers.{name}": environment_code(name, self.folder).source for name in names}
        libraries = code.libraries | ({"supersuit": version("supersuit")} if self.wrappers else {})
        return {f"environment.{name}": value for name, value in identity.items()} | libraries
