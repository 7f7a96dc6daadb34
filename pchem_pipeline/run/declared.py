"""What each stage declares: its upstream, the settings that it reads, what it reads and writes.

This is all that is needed to say how far a run is. It stands apart from the stages' modules, which bring the
libraries that do the work, so that ``pchem status`` answers at once. A stage's module takes its ``NAME``,
``VERSION``, ``UPSTREAM``, ``SETTINGS``, ``READS``, ``WRITES`` and ``identity`` from here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pchem_pipeline.run import identities

if TYPE_CHECKING:
    from pchem_pipeline.run.stage import StageContext

__all__ = ["DECLARED", "Declaration"]


@dataclass(frozen=True)
class Declaration:
    """The names that a stage's module offers, beside its functions; see :mod:`pchem_pipeline.run.stage`."""

    NAME: str
    VERSION: int
    UPSTREAM: tuple[str, ...]
    SETTINGS: tuple[str, ...]
    READS: tuple[str, ...]
    WRITES: tuple[str, ...]
    identity: Callable[[StageContext], Any] | None = None

    @property
    def module(self) -> str:
        """Return the full name of the stage's module."""
        return f"pchem_pipeline.stages.{_MODULES.get(self.NAME, self.NAME)}"


#: modules of stages that are folders or share one
_MODULES = {
    "histogram": "histogram.histogram",
    "fit": "fit.fit",
    "ensemble": "ensemble.ensemble",
    "report": "report.report",
    "electrons": "electrons.electrons",
    "discrepancy": "discrepancy.discrepancy",
    "joint": "joint.joint",
    "joint_report": "joint.report",
    "methods": "methods.methods",
}


_INPUT_SETTINGS = (
    "format",
    "mode",
    "shape",
    "dtype",
    "byte_order",
    "header_bytes",
    "frame_padding_bytes",
    "dataset",
    "bit_shift",
    "bit_depth",
    "roi",
    "frame_range",
    "on_bad_file",
)

_ALL = (
    Declaration("simulate", 1, (), ("simulate",), (), ("truth",)),
    # not files: their content counts; not integration_time: it changes no frame
    Declaration(
        "ingest",
        1,
        (),
        tuple(f"input.{name}" for name in _INPUT_SETTINGS),
        (),
        ("frames",),
        identities.input_content,
    ),
    # band_memory is not among the settings: it changes no result
    Declaration(
        "histogram",
        1,
        ("ingest",),
        (
            "histogram.block_frames",
            "histogram.window_frames",
            "histogram.max_bins",
            "histogram.summaries",
            "run.tile",
        ),
        ("frames",),
        ("histogram", "summary"),
    ),
    Declaration(
        "fit",
        5,
        ("histogram",),
        ("fit", "model", "run.tile"),
        ("histogram/counts", "histogram/origin", "histogram/under", "histogram/over"),
        ("fit",),
        identities.fit_inputs,
    ),
    Declaration("maps", 3, ("fit",), ("maps", "run.tile"), ("fit",), ("maps",), identities.integration_time),
    Declaration(
        "ensemble",
        2,
        ("histogram", "fit"),
        ("ensemble", "run.tile"),
        ("frames", "histogram", "fit", "truth"),
        ("ensemble", "ensemble_tiles"),
    ),
    Declaration(
        "report",
        2,
        ("histogram", "fit", "maps", "ensemble"),
        ("report", "maps", "run.title", "run.allowed_failed_pixels"),
        ("histogram", "summary", "fit", "maps", "ensemble", "discrepancy", "truth"),
        (),
        identities.verdict,
    ),
    Declaration("electrons", 1, ("ingest", "fit"), ("run.tile",), ("frames", "fit"), ("electrons",)),
    Declaration(
        "discrepancy",
        4,
        ("ingest",),
        ("discrepancy",),
        ("frames",),
        ("discrepancy",),
        identities.search_start,
    ),
    # of a joint fit, whose samples are other runs
    Declaration("joint", 1, (), ("fit", "maps", "run.tile"), (), ("joint", "maps"), identities.joint_samples),
    Declaration(
        "joint_report",
        1,
        ("joint",),
        ("report", "run.title", "run.allowed_failed_pixels"),
        ("joint", "maps"),
        (),
    ),
    Declaration(
        "methods",
        1,
        ("histogram", "fit"),
        ("methods",),
        ("histogram", "fit", "truth"),
        ("methods",),
        identities.other_samples,
    ),
)

#: Declaration of each stage, by name.
DECLARED = MappingProxyType({declaration.NAME: declaration for declaration in _ALL})
