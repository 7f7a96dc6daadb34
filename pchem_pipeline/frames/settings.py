"""The YAML section ``input``: which camera files are read, and how."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from pchem_pipeline.base.settings import Place, Section
from pchem_pipeline.frames.camera import LONGEST, SHORTEST


class SampleSettings(Section):
    """One exposure of several that are fitted together: an ordinary run of the same pixels."""

    run: str = Field(min_length=1, description="config.yaml or store of the run, relative to this file")
    bias: bool = Field(
        default=False, description="frames without any electrons, H = 0; they pin the bias and the read noise"
    )
    integration_time: float | None = Field(
        default=None,
        ge=0,
        le=LONGEST,
        description="s; null: what the run says. 0 is allowed: no time to integrate",
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
        "fitted together with one g, mu and sigma for each pixel; entries: run, bias, integration_time, "
        "light_level",
    )
    against: Literal["integration_time", "light_level", "none"] = Field(
        default="integration_time",
        description="samples: what their exposures are drawn against. integration_time: the slope of H is "
        "the charge rate (in the dark the dark current) and its offset the spurious charge. none: no line",
    )
    shown_sample: int | None = Field(
        default=None,
        ge=0,
        description="samples: whose histograms, H and ensemble are shown, counted from 0; null: the last "
        "that holds electrons",
    )
    kind: Literal["dark", "light", "unknown"] = Field(
        default="unknown",
        description="what made the charge: dark (nothing but the sensor: H over time is its dark current), "
        "light, or unknown; of the last two H over time is called charge rate",
    )
    format: str = Field(
        default="auto",
        description="auto (from the content, then the suffix), raw, npy, tiff, fits, hdf5, zarr, ser, "
        "histogram (ready-made histograms), or the name of a reader from a plug-in",
    )
    mode: Literal["copy", "reference"] = Field(
        default="copy",
        description="copy: frames go into the store; reference: nothing is copied, the camera files must "
        "stay",
    )
    shape: tuple[int, ...] | None = Field(
        default=None,
        description="raw only: [rows, columns], or [frames, rows, columns]; null: from the sidecar file",
    )
    dtype: Literal["uint8", "uint16", "uint32"] | None = Field(
        default=None,
        description="raw: type of a sample; other formats: reads signed samples of that size as unsigned, "
        "negative values being refused; null: from the file or its sidecar",
    )
    offset: int | None = Field(
        default=None,
        ge=0,
        le=1 << 31,
        description="DN to be added to signed samples: 32768 where 16 bits are stored as -32768 to 32767; "
        "null: from the file (FITS: BZERO), else none",
    )
    byte_order: Literal["little", "big"] | None = Field(
        default=None,
        description="raw and SER: order of the bytes of a sample; null: from the file, else little, "
        "and refused where the samples look otherwise",
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
        "null: the only 3-D array, or image, there",
    )
    bit_shift: int | None = Field(
        default=None,
        ge=0,
        le=31,
        description="bits to shift right, for left-justified data (12 bits in 16: 4); the bits dropped must "
        "be zero; null: from the sidecar, else 0",
    )
    bit_depth: int | None = Field(
        default=None,
        ge=1,
        le=32,
        description="bits of the ADC, after bit_shift; null: from the file, else unknown (then "
        "saturation at the "
        "top of the range cannot be told from a clipped histogram)",
    )
    mask: Place | None = Field(
        default=None,
        description="image file (npy, TIFF, FITS) of the shape of the frames or of roi, relative to this "
        "YAML file: pixels other than 0 are excluded, and so are those that always hold the marker 2^32-1",
    )
    roi: tuple[int, int, int, int] | None = Field(
        default=None, description="region of interest [y0, y1, x0, x1] in pixels, ends excluded; null: all"
    )
    frame_range: tuple[int, int | None] | None = Field(
        default=None,
        description="[first, end] frame over all files together, end excluded, null end: to the last; "
        "null: all",
    )
    integration_time: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST,
        description="integration time of a frame, s; null: from the file, else unknown (no charge rate then)",
    )
    on_bad_file: Literal["error", "skip"] = Field(
        default="error",
        description="unreadable, truncated, duplicate or odd-shaped files: error stops and lists them all; "
        "skip leaves them out and reports them",
    )

    @model_validator(mode="after")
    def _check_samples(self) -> Self:
        if not self.samples:
            return self
        if self.files:
            raise ValueError("files and samples: give one of them; samples are runs of their own")
        if all(sample.bias for sample in self.samples):
            raise ValueError("samples: every sample is a bias; list at least one that holds electrons")
        shown = self.shown_sample
        if shown is not None and (shown >= len(self.samples) or self.samples[shown].bias):
            raise ValueError(f"shown_sample: {shown} is no sample that holds electrons; choose another")
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        times = [self.integration_time, *(sample.integration_time for sample in self.samples)]
        if any(0 < (time or 0) < SHORTEST for time in times):
            raise ValueError(f"integration_time must be at least {SHORTEST:g} s")
        if self.shape is not None and (len(self.shape) not in (2, 3) or min(self.shape) < 1):
            raise ValueError("shape must be [rows, columns] or [frames, rows, columns], each at least 1")
        if self.roi is not None:
            y0, y1, x0, x1 = self.roi
            if not (0 <= y0 < y1 and 0 <= x0 < x1):
                raise ValueError("roi must be [y0, y1, x0, x1] with 0 <= y0 < y1 and 0 <= x0 < x1")
        if self.frame_range is not None:
            first, end = self.frame_range
            if first < 0 or (end is not None and end <= first):
                raise ValueError("frame_range must be [first, end] with 0 <= first < end")
        return self
