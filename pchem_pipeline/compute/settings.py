"""The YAML section ``compute``."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from pchem_pipeline.base.settings import Section
from pchem_pipeline.compute.environment import available_workers


class ComputeSettings(Section):
    """Who does the work. None of these settings changes a result."""

    backend: Literal["serial", "threads", "processes", "distributed"] = Field(
        default="threads", description="serial | threads | processes | distributed"
    )
    workers: int | Literal["auto"] = Field(
        default="auto", description="number of workers; auto: the processors available to this process"
    )
    max_memory: int | None = Field(
        default=None,
        gt=0,
        description="memory limit of a run on this machine, MiB, at least 300; null: half of the free "
        "memory. If it is too low for the whole sensor at once, the camera files are read twice, in bands of "
        "rows",
    )
    scheduler: str | None = Field(
        default=None,
        description="distributed: tcp://host:8786 or the path of a scheduler file; null: a local cluster",
    )
    wait_for_workers: float = Field(
        default=300.0,
        gt=0,
        description="distributed: seconds to wait for a worker before the run stops; more if jobs wait in a "
        "queue",
    )
    cluster: dict[str, Any] | None = Field(
        default=None, description="of earlier versions; start a cluster yourself, and give its scheduler"
    )

    def count(self) -> int:
        """Return the workers on this machine that are asked for."""
        if self.backend == "serial":
            return 1
        return available_workers() if self.workers == "auto" else self.workers
