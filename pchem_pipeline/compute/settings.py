"""The YAML section ``compute``."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from pchem_pipeline.base.settings import Section


class ClusterSettings(Section):
    """A dask cluster made by the run, for example ``dask_jobqueue.SLURMCluster``."""

    cls: str = Field(
        alias="class", description="module and class of the cluster, such as dask_jobqueue.SLURMCluster"
    )
    kwargs: dict[str, Any] = Field(default_factory=dict, description="arguments of the class")
    scale: int = Field(default=1, ge=1, description="number of workers to ask for")


class ComputeSettings(Section):
    """Who does the work. None of these settings changes a result."""

    backend: Literal["serial", "threads", "processes", "distributed"] = Field(
        default="threads", description="serial | threads | processes | distributed"
    )
    workers: int | Literal["auto"] = Field(
        default="auto", description="number of workers; auto: the processors that this process may use"
    )
    max_memory: int | None = Field(
        default=None,
        gt=0,
        description="memory that a run may take on this machine, MiB, 300 or more; null: half of what is "
        "free. Too little for the whole sensor at once: the camera files are read twice, by bands of rows",
    )
    scheduler: str | None = Field(
        default=None,
        description="distributed: tcp://host:8786 or the path of a scheduler file; null: a local cluster",
    )
    wait_for_workers: float = Field(
        default=300.0,
        gt=0,
        description="distributed: seconds without a worker that can work after which the run gives up; "
        "more where jobs wait in a queue",
    )
    cluster: ClusterSettings | None = Field(default=None, description="distributed: {class, kwargs, scale}")
