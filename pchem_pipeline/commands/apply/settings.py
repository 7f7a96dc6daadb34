"""What ``pchem apply`` is asked for, and what its workers are given."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.use.common_modes import CommonModes
from pchem_pipeline.use.overscan import Overscan

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence
    from pchem_pipeline.use.exposure import ExposurePool  # loads compiled loops

#: What can be asked for.
KINDS = ("electrons", "numbers", "exposure")


def at_limit(codes: NDArray[Any], limits: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which samples are at the first or the last code of the ADC, or beyond."""
    return np.asarray((codes <= limits[0]) | (codes >= limits[1]))


@dataclass(frozen=True)
class ApplySettings:
    """What the command line asks for.

    Attributes:
        kinds: any of `KINDS`.
        prior: exposure that the electron numbers are expected to have: ``frames`` (estimated from these
            frames), ``flat`` (none) or ``run`` (of the characterisation).
        reference: pixels from which the subtracted offsets of frames, rows and columns are estimated:
            ``pixels`` (all, for the offsets in the model of the run), ``overscan`` or ``none``.
        format: of the output: zarr, tiff or fits.
        dataset: which frames inside an HDF5, zarr or FITS file; None: as the run has it.
    """

    kinds: tuple[str, ...] = KINDS
    prior: str = "frames"
    reference: str = "pixels"
    format: str = "zarr"
    dataset: str | None = None


def kinds_of(text: str) -> tuple[str, ...]:
    """Return the kinds that ``--what`` names.

    Raises:
        ConfigError: it names something else.
    """
    asked = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [part for part in asked if part not in (*KINDS, "all")]
    if unknown or not asked:
        raise ConfigError(f"--what {text}: choose from {', '.join(KINDS)}, all; several separated by commas")
    return KINDS if "all" in asked else tuple(kind for kind in KINDS if kind in asked)


@dataclass(frozen=True)
class Piece:
    """Rows ``y0:y1`` of frames ``t0:t1``: name of the work, and number of the segment of frames."""

    name: str
    y0: int
    y1: int
    t0: int
    t1: int
    number: int = 0

    @property
    def key(self) -> str:
        """What messages and markers call it."""
        return f"{self.name}-{self.y0}-{self.t0}"


@dataclass(frozen=True)
class Job:
    """What the workers know.

    Attributes:
        run: store of the characterisation.
        source: the frames.
        kinds: what is wanted.
        prior: as in `ApplySettings`.
        pool: what the exposures of these frames have in common, where they are the prior.
        limits: first and last code of the ADC, DN; None: not known.
        modes: offsets that are taken from the frames; none: the frames as they come.
        overscan: in which the offsets are measured; None: in all pixels.
        scene: expected exposure while they are measured in all pixels, (y, x), e-.
        offset_variance: variance of the offsets' estimates, DN^2, (y, x); None without offsets.
        row_sums: of the mean of each row less its bias over the frames, and of its square, DN and DN^2, with
            the offsets and without: shape (2, 2, y).
        moments: whether the errors of the calibration are in the output, by `moments_piece`.
        parts: codes in a DN.
        lift: DN by which codes are raised so that none is negative; no offset is larger.
        reached: whether samples lie at the first and at the last code of the ADC.
        bins: of the histograms.
        window: frames of a block while counting.
        depth: frames of a chunk.
        traps: whether telegraph jumps are taken from the electrons of pixels with a trap.
        number_type: of the electron numbers.
        expected: whether E[k | x] is written.
    """

    run: Path
    source: FrameSequence
    kinds: tuple[str, ...]
    prior: str = "frames"
    pool: ExposurePool | None = None
    limits: tuple[int, int] | None = None
    modes: CommonModes = field(default_factory=CommonModes)
    overscan: Overscan | None = None
    scene: Any = None
    offset_variance: Any = None
    row_sums: Any = None
    moments: bool = False
    parts: int = 1
    lift: int = 0
    reached: tuple[bool, bool] = (True, True)
    bins: int = 0
    window: int = 256
    depth: int = 1
    traps: bool = False
    number_type: Any = np.uint16
    expected: bool = False

    @property
    def removed(self) -> tuple[str, ...]:
        """Tags of the effects whose offsets are taken from the frames."""
        return self.modes.removed

    @property
    def cut(self) -> tuple[int | None, int | None]:
        """Codes at and beyond which samples are censored, DN; None: there are none.

        Less its offset a sample at a limit of the ADC may be anywhere within the largest offset from it.
        """
        low, high = self.limits or (None, None)
        return (
            None if low is None or not self.reached[0] else low + self.lift,
            None if high is None or not self.reached[1] else high - self.lift,
        )

    @property
    def counts(self) -> bool:
        """Whether histograms are needed."""
        return self.by_code or "exposure" in self.kinds

    @property
    def by_code(self) -> bool:
        """Whether samples are looked up by their code."""
        return "numbers" in self.kinds or self.traps

    @property
    def learns_prior(self) -> bool:
        """Whether the prior of electron numbers and jumps is of these frames."""
        return self.by_code and self.prior == "frames"

    @property
    def estimates(self) -> bool:
        """Whether the exposure of these frames is needed."""
        return "exposure" in self.kinds or self.learns_prior

    @property
    def converts(self) -> bool:
        """Whether frames are written."""
        return "numbers" in self.kinds or "electrons" in self.kinds
