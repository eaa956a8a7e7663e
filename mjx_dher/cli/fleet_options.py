"""The options of a sweep over many machines. Loads neither Ray nor JAX."""

from __future__ import annotations

import dataclasses
from typing import Literal

from mjx_dher.fleet import plan
from mjx_dher.fleet.plan import Request


@dataclasses.dataclass(frozen=True)
class FleetArgs:
    """Options of a sweep over many machines."""

    ray: str | None = None
    """Train on a Ray cluster: local (all GPUs or cores of this machine), auto (the cluster that it is part of) or HOST:PORT of
    the cluster's head (docs/scaling.md). Needs the extra ray."""
    ray_on: Literal["auto", "gpu", "cpu", "both"] = "auto"
    """Tasks take a GPU each, cores (see ray_cpus), or there are both kinds; auto: GPUs where the cluster has any."""
    ray_cpus: int | None = None
    """Cores of a task on CPUs; by default all those of the smallest node."""
    ray_chunk: int | None = None
    """Runs of a task; by default as many as keep all of the cluster at work until the end, and fit a GPU's memory."""
    storage: str | None = None
    """Folder that all nodes see, or gs://, s3://, az://, for checkpoints: a lost node then costs no more than one interval."""


def request_of(args: FleetArgs) -> Request | None:
    """Returns what is asked of a fleet; None where none is.

    Raises:
      ValueError: it cannot be met, or there are options of a fleet without --ray.
    """
    if args.ray is None:
        given = {field.name: getattr(args, field.name) for field in dataclasses.fields(args) if field.name != "ray"}
        for name, value in given.items():
            if value != getattr(FleetArgs, name):
                raise ValueError(f"{name} is for --ray local, auto or HOST:PORT, which is not given; got {value!r}")
        return None
    request = Request(args.ray, args.ray_on, args.ray_cpus, args.ray_chunk, args.storage)
    plan.check(request)
    return request
