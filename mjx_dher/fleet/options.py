"""Options of a sweep on a Ray cluster. Loads neither Ray nor JAX."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from mjx_dher import lookup
from mjx_dher.validation import check_count, host_and_port

LOCAL = "local"


@dataclasses.dataclass(frozen=True)
class FleetOptions:
    """Options of a sweep on a Ray cluster."""

    ray: str | None = None
    """Train on a Ray cluster: local (all GPUs or cores of this machine), auto (this machine's cluster) or HOST:PORT of a
    cluster's head (docs/scaling.md). Needs the extra ray."""
    ray_cpus: int | None = None
    """Train on CPUs with this many cores per task. Default: one GPU per task, or all cores of a node without GPUs."""
    ray_chunk: int | None = None
    """Runs per task. Default: as many as keep the whole cluster busy."""
    storage: Path | None = None
    """Folder shared by all nodes, for checkpoints. A lost node then costs at most one interval."""

    def check(self) -> None:
        """Raises ValueError for an invalid option, before Ray is loaded."""
        if self.ray is None:
            for name in ("ray_cpus", "ray_chunk", "storage"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} needs --ray local, auto or HOST:PORT; got {getattr(self, name)} without it")
            return
        if self.ray not in (LOCAL, "auto"):
            host_and_port("ray", self.ray, "local, auto (this machine's cluster), or HOST:PORT of a head")
        for name in ("ray_cpus", "ray_chunk"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name))
        if self.storage is not None:
            is_url = ":" in str(self.storage).partition("/")[0]
            if is_url or (self.storage.exists() and not self.storage.is_dir()):
                raise ValueError(f"storage must be a folder; got {str(self.storage)!r}")
        lookup.require_extra("--ray", "ray", "ray")
