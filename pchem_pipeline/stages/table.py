"""The table of stages: what each needs and writes, which settings decide it, and what does it.

The runner, the session and the command line know the stages from here only. A new stage is a row and a module
with ``run(context)``. Nothing that computes is imported here, so that ``pchem status`` answers at once.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

from pchem_pipeline.run.declaration import Stage

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig

_HERE = "pchem_pipeline.stages"

_INPUT_SETTINGS = (
    "format",
    "mode",
    "shape",
    "dtype",
    "offset",
    "byte_order",
    "packing",
    "header_bytes",
    "frame_padding_bytes",
    "dataset",
    "bit_shift",
    "bit_depth",
    "mask",
    "overscan",
    "roi",
    "frame_range",
    "on_bad_file",
)

_LINE = ("linearity_residual", "linearity_residual_stderr", "linearity_chi2", "linearity_p")


_ALL = (
    Stage(
        "simulate",
        version=1,
        upstream=(),
        settings=("simulate",),
        writes=("truth",),
        run=f"{_HERE}.simulate:run",
        identity=f"{_HERE}.simulate:scene_identity",
        summary="Simulate a camera: write its frames and true parameters.",
        applies=lambda config: config.simulate is not None,
    ),
    Stage(
        "ingest",
        version=1,
        upstream=(),
        # not files: their content counts; not integration_time: it changes no frame
        settings=tuple(f"input.{name}" for name in _INPUT_SETTINGS),
        writes=("frames", "overscan"),
        run=f"{_HERE}.ingest:run",
        identity=f"{_HERE}.identities:input_content",
        follows=("simulate",),
        reads_input=True,
    ),
    Stage(
        "histogram",
        version=3,
        upstream=("ingest",),
        # not band_memory: it changes no result
        settings=(
            "histogram.block_frames",
            "histogram.window_frames",
            "histogram.max_bins",
            "histogram.summaries",
            "run.tile",
        ),
        writes=("histogram", "summary"),
        run=f"{_HERE}.histogram.histogram:run",
        single_pass=f"{_HERE}.histogram.single_pass:count_in_one_pass",
        summary="Make pixel histograms, and sums in time and space.",
        plan=f"{_HERE}.histogram.dry_run:plan_lines",
    ),
    Stage(
        "fit",
        version=9,
        upstream=("histogram",),
        settings=("fit", "run.tile"),
        writes=("fit", "samples"),
        run=f"{_HERE}.fit.fit:run",
        identity=f"{_HERE}.identities:fit_inputs",
        summary="Fit H, g, mu and sigma of each pixel by PCH-EM.",
        status_words="fit/fit_status",
    ),
    Stage(
        "maps",
        version=5,
        upstream=("fit",),
        settings=("maps", "run.tile"),
        writes=("maps", *(f"samples/{name}" for name in _LINE)),
        run=f"{_HERE}.maps:run",
        identity=f"{_HERE}.identities:integration_time",
        summary="Make the parameter maps with standard errors and quality.",
    ),
    Stage(
        "ensemble",
        version=4,
        upstream=("histogram", "fit"),
        settings=("ensemble", "run.tile"),
        writes=("ensemble", "ensemble_tiles"),
        run=f"{_HERE}.ensemble.ensemble:run",
        summary="Predict the ensemble from the maps and compare with data.",
        may_write_nothing=True,
    ),
    Stage(
        "report",
        version=7,
        upstream=("histogram", "fit", "maps", "ensemble"),
        settings=("report", "maps", "run.title", "run.allowed_failed_pixels", "input.kind"),
        writes=(),
        run=f"{_HERE}.report.report:run",
        files=("report.html", "report.json", "discrepancy.html"),
        identity=f"{_HERE}.identities:verdict",
        summary="Write report.html and report.json.",
    ),
    Stage(
        "electrons",
        version=1,
        upstream=("ingest", "fit"),
        settings=("run.tile",),
        writes=("electrons",),
        run=f"{_HERE}.electrons:run",
        summary="Write the electron number of each sample into the store.",
        on_demand=True,
    ),
    Stage(
        "discrepancy",
        version=17,
        upstream=("ingest",),
        settings=("discrepancy",),
        writes=("discrepancy",),
        run=f"{_HERE}.discrepancy.discrepancy:run",
        files=("discrepancy.json",),
        identity=f"{_HERE}.identities:search_start",
        on_demand=True,
        may_write_nothing=True,
    ),
    Stage(
        "methods",
        version=1,
        upstream=("histogram", "fit"),
        settings=("methods",),
        writes=("methods",),
        run=f"{_HERE}.methods:run",
        files=("methods.json",),
        identity=f"{_HERE}.identities:other_samples",
        on_demand=True,
    ),
)

#: Each stage by its name, in the order of the data.
STAGES = MappingProxyType({stage.name: stage for stage in _ALL})


def pipeline() -> tuple[str, ...]:
    """Return the stages that ``pchem run`` may do, in their order."""
    return tuple(stage.name for stage in _ALL if not stage.on_demand)


def pipeline_of(config: RunConfig) -> tuple[str, ...]:
    """Return the stages that ``pchem run`` does in a run of this configuration, in their order."""
    return tuple(name for name in pipeline() if STAGES[name].applies(config))
