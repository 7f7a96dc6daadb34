"""The YAML section ``input``: which camera files are read, and how."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from pchem_pipeline.base.settings import Place, Section
from pchem_pipeline.frames.camera import LONGEST, SHORTEST

PackingName = Literal["Mono10p", "Mono12p", "Mono10Packed", "Mono12Packed"]
#: First row, end of the rows, first column, end of the columns.
Area = tuple[int, int, int, int]


class SampleSettings(Section):
    """One exposure of several that are fitted together: an ordinary run of the same pixels."""

    run: str = Field(min_length=1, description="config.yaml or store of the run, relative to this file")
    bias: bool = Field(default=False, description="bias frames (H = 0): fix bias and read noise")
    integration_time: float | None = Field(
        default=None, ge=0, le=LONGEST, description="s; 0 is allowed; null: as in the run"
    )
    light_level: float | None = Field(
        default=None, ge=0, description="exposure in any unit, for input.against: light_level"
    )


def _listed(files: Any) -> Any:
    """Take one place for a list of it."""
    return [files] if isinstance(files, str) else files


class InputSettings(Section):
    """Camera files (or ready-made histograms, or other runs) and what their format does not say itself.

    A value given here wins over what the file, its header or its sidecar says. ``None`` means:
    take it from the file; if the file does not say, the value stays unknown and is never guessed.
    """

    files: Annotated[
        tuple[Place, ...], BeforeValidator(_listed, json_schema_input_type=Place | tuple[Place, ...])
    ] = Field(
        default=(),
        description="camera files, globs or folders, one or a list of them, relative to this YAML file, or "
        "URLs such as s3://bucket/frames/*.tif; "
        "read in natural order of their names (frame2 before frame10)",
    )
    samples: tuple[SampleSettings, ...] = Field(
        default=(),
        max_length=64,
        description="instead of files: several exposures in increasing order, each a run of the same pixels, "
        "fitted jointly (one g, mu and sigma per pixel); entries: run, bias, integration_time, light_level",
    )
    against: Literal["integration_time", "light_level", "none"] = Field(
        default="integration_time",
        description="samples: axis of the exposures. integration_time: the slope of H is the charge rate (in "
        "the dark the dark current), the offset the spurious charge. none: no line",
    )
    shown_sample: int | None = Field(
        default=None,
        ge=0,
        description="samples: the one whose histograms, H and ensemble are shown, counted from 0; null: the "
        "last with electrons",
    )
    kind: Literal["dark", "light", "unknown"] = Field(
        default="unknown",
        description="source of the charge: dark (H / time is the dark current), light or unknown (H / time "
        "is a charge rate)",
    )
    format: str = Field(
        default="auto",
        description="auto (from the content, then the suffix), raw, npy, tiff, fits, hdf5, zarr, ser, "
        "dcimg, spe, sif, nd2, histogram (ready-made histograms), or the name of a reader from a plug-in",
    )
    mode: Literal["copy", "reference"] = Field(
        default="reference",
        description="reference: frames stay in the camera files, which must stay in place; copy: into the "
        "store, for files that will be moved or deleted, or are slow to read (network, compressed)",
    )
    shape: tuple[int, ...] | None = Field(
        default=None,
        description="raw only: [rows, columns], or [frames, rows, columns]; null: from the sidecar file",
    )
    dtype: Literal["uint8", "uint16", "uint32"] | None = Field(
        default=None,
        description="raw: sample type; other formats: unsigned type for signed samples without negative "
        "values; null: from the file or its sidecar",
    )
    offset: int | None = Field(
        default=None,
        ge=0,
        le=1 << 31,
        description="DN to add to signed samples, such as 32768 for 16 bits stored as -32768 to 32767; null: "
        "from the file (FITS: BZERO), else 0",
    )
    byte_order: Literal["little", "big"] | None = Field(
        default=None,
        description="raw and SER: byte order; null: from the file, else little (an error if the samples look "
        "byte-swapped)",
    )
    packing: PackingName | None = Field(
        default=None,
        description="raw only, instead of dtype: pixel format of packed samples: Mono10p, Mono12p (GenICam), "
        "Mono10Packed, Mono12Packed (GigE Vision); null: from the sidecar, else they are not packed",
    )
    header_bytes: int | None = Field(
        default=None,
        ge=0,
        description="raw only: bytes before the first frame; null: from the sidecar, else 0",
    )
    frame_padding_bytes: int | None = Field(
        default=None, ge=0, description="raw only: bytes after each frame; null: from the sidecar, else 0"
    )
    dataset: str | None = Field(
        default=None,
        description="HDF5 and zarr: path of the array inside the file; FITS: number or name of the image; "
        "null: the only 3-D array or image",
    )
    bit_shift: int | None = Field(
        default=None,
        ge=0,
        le=31,
        description="bits to shift right, for left-justified samples (12 bits in 16: 4); the dropped bits "
        "must be zero; null: from the sidecar, else 0",
    )
    bit_depth: int | None = Field(
        default=None,
        ge=1,
        le=32,
        description="bits of the ADC, after bit_shift; null: from the file, else unknown (saturation is "
        "then seen where many samples have the highest code)",
    )
    mask: Place | None = Field(
        default=None,
        description="image file (npy, TIFF, FITS) with the shape of the frames or of roi, relative to this "
        "YAML file: pixels other than 0 are excluded; so are overscan and pixels that always have the marker "
        "2^32-1",
    )
    overscan: tuple[Area, ...] | None = Field(
        default=None,
        description="pixels without electrons (overscan, dark reference rows or columns), regions of the "
        "files as in roi: [[y0, y1, x0, x1], ...]; they tell bias and row noise, and are excluded from all "
        "else; null: from the file (FITS: BIASSEC, else all outside of TRIMSEC or DATASEC)",
    )
    roi: Area | None = Field(
        default=None, description="region of interest [y0, y1, x0, x1] in pixels, ends excluded; null: all"
    )
    frame_range: tuple[int, int | None] | None = Field(
        default=None,
        description="range of frames [first, end] over all files, end excluded, null end: to the last; null: "
        "all",
    )
    integration_time: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST,
        description="integration time per frame, s; null: from the file, else unknown (no charge rate)",
    )
    line_time: float | None = Field(
        default=None,
        ge=SHORTEST,
        le=LONGEST,
        description="time from one row to the next while a frame is read, s; pchem discrepancy then states "
        "the frequency of periodic pickup in Hz; null: unknown",
    )
    on_bad_file: Literal["error", "skip"] = Field(
        default="error",
        description="unreadable, truncated, duplicate or odd-shaped files: error: stop and list them; skip: "
        "ignore and report them",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        shown, lit = self.shown_sample, [n for n, sample in enumerate(self.samples) if not sample.bias]
        if self.samples and self.files:
            raise ValueError("files and samples: give only one of them")
        if self.samples and not lit:
            raise ValueError("samples: every sample is a bias; list at least one with electrons")
        if self.samples and shown is not None and shown not in lit:
            raise ValueError(f"shown_sample: {shown} is not a sample with electrons; choose another")
        times = [self.integration_time, *(sample.integration_time for sample in self.samples)]
        if any(0 < (time or 0) < SHORTEST for time in times):
            raise ValueError(f"integration_time must be at least {SHORTEST:g} s")
        if self.shape is not None and (len(self.shape) not in (2, 3) or min(self.shape) < 1):
            raise ValueError("shape must be [rows, columns] or [frames, rows, columns], each at least 1")
        for name, areas in (("roi", (self.roi,)), ("each region of overscan", self.overscan or ())):
            for y0, y1, x0, x1 in filter(None, areas):
                if not (0 <= y0 < y1 and 0 <= x0 < x1):
                    raise ValueError(f"{name} must be [y0, y1, x0, x1] with 0 <= y0 < y1 and 0 <= x0 < x1")
        if self.frame_range is not None:
            first, end = self.frame_range
            if first < 0 or (end is not None and end <= first):
                raise ValueError("frame_range must be [first, end] with 0 <= first < end")
        return self
