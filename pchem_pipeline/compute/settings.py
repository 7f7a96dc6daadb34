"""The YAML section ``compute``."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field, field_validator

from pchem_pipeline.base.settings import Section

_QUEUES = ("HTCondor", "LSF", "Moab", "OAR", "PBS", "SGE", "SLURM")
#: A YAML, and the store that keeps it, may be somebody else's: it names a cluster and how large it is, but
#: nothing that is run or loaded.
_CLASSES = ("distributed.LocalCluster", *(f"dask_jobqueue.{name}Cluster" for name in _QUEUES))
_ARGUMENTS = (
    "account", "cores", "dashboard_address", "death_timeout", "disk", "host", "interface", "job_cpu",
    "job_mem", "local_directory", "log_directory", "memory", "memory_limit", "n_workers", "nanny",
    "processes", "project", "queue", "resource_spec", "threads_per_worker", "walltime",
)  # fmt: skip
_WORD = re.compile(r"(?!-)[\w.,:/=+@%-]*", re.ASCII)  # no more: it becomes part of a job's script


class ClusterSettings(Section):
    """A dask cluster made by the run, for example ``dask_jobqueue.SLURMCluster``."""

    cls: str = Field(alias="class", description="distributed.LocalCluster, or one of dask_jobqueue")
    kwargs: dict[str, Any] = Field(default_factory=dict, description="arguments of the class: sizes, names")
    scale: int = Field(default=1, ge=1, description="number of workers to request")

    @field_validator("cls")
    @classmethod
    def _known_class(cls, value: str) -> str:
        if value not in _CLASSES:
            raise ValueError(
                f"{value} is not one of {', '.join(_CLASSES)}; start other clusters yourself, and give the "
                "address as compute.scheduler"
            )
        return value

    @field_validator("kwargs")
    @classmethod
    def _harmless(cls, value: dict[str, Any]) -> dict[str, Any]:
        for name, given in value.items():
            plain = (
                _WORD.fullmatch(given) if isinstance(given, str) else isinstance(given, int | float | None)
            )
            if name not in _ARGUMENTS or not plain:
                raise ValueError(
                    f"{name}: {given!r} is not taken from a run's YAML, only numbers and single words for "
                    f"{', '.join(_ARGUMENTS)}; others belong into your own configuration of dask "
                    "(~/.config/dask)"
                )
        return value


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
    cluster: ClusterSettings | None = Field(default=None, description="distributed: {class, kwargs, scale}")
