"""Stages on a run of a test: its context by sections of the YAML, and stages that must end complete."""

from pchem_pipeline.compute.executor import SerialExecutor
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.signals import StopRequest
from pchem_pipeline.run.stage import Command, StageContext
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.store.run_store import RunStore


def stage_context(folder, executor=None, command=None, stop=None, **sections):
    """Return the context of a run in a folder; its store is made where there is none."""
    config = RunConfig.model_validate(sections)
    return StageContext(
        config,
        folder,
        RunStore.create(folder / config.run.store),
        executor or SerialExecutor(),
        Reporter("off", quiet=True),
        stop or StopRequest(),
        command=command or Command(),
    )


def completed(context, *stages):
    """Do stages, each of which must end complete; return the context."""
    for stage in stages:
        assert execute(stage, context).state == "complete"
    return context
