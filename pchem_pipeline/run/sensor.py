"""What the run knows of the sensor once its input was looked at."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pchem_pipeline.base.errors import StoreError, quoted
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.store.run_store import RunStore


@dataclass(frozen=True)
class Sample:
    """One of several exposures that are fitted together, by the name of its store; a bias holds no electrons.

    The integration time (s) and the kind (dark, light or unknown) are as its run says.
    """

    name: str
    bias: bool
    n_frames: int
    integration_time: float | None
    kind: str = "unknown"


@dataclass(frozen=True)
class SensorInfo:
    """The input as the later stages see it; kept in the attributes of the group ``frames``.

    Attributes:
        kind: frames; ready-made histograms (no order in time, no neighbours); or samples, other runs of the
            same pixels that are fitted together.
        n_frames: number of frames (for histograms: the largest number of samples of a channel; for samples:
            of all together).
        nx: columns (for histograms: channels).
        dtype: numpy name of the DN type.
        bit_depth: bits of the ADC, if known; codes at its limits count as clipped.
        seen_limits: lowest and highest code at which samples pile up; None: they do not.
        integration_time: seconds per frame as the files say, if they do.
        mode: copy (``frames/dn`` holds the frames) or reference (they stay in the camera files).
        identity: names, sizes and content hashes of the files.
        names: names of the channels of ready-made histograms.
        samples: the exposures, where there are several.
        shown: place of the one whose histograms, H and ensemble are shown.
        whole: rows and columns of the frames in the files, whatever the region of interest; None: not known.
        reader: format of the files and the library that read them; empty: not known.
    """

    kind: Literal["frames", "histograms", "samples"]
    n_frames: int
    ny: int
    nx: int
    dtype: str
    bit_depth: int | None
    integration_time: float | None
    mode: Literal["copy", "reference"]
    identity: dict[str, Any]
    names: tuple[str, ...] = ()
    samples: tuple[Sample, ...] = ()
    shown: int = 0
    camera: CameraFacts = field(default_factory=CameraFacts)
    whole: tuple[int, int] | None = None
    seen_limits: tuple[int | None, int | None] = (None, None)
    reader: str = ""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.ny, self.nx

    @property
    def adc_limits(self) -> tuple[int, int] | None:
        """First and last code of ADC or type of the samples, or where these pile up; None: not known."""
        kind = np.dtype(self.dtype)
        if self.bit_depth is None and kind.kind != "u":
            return None
        low, high = self.seen_limits
        return low or 0, high or 2 ** (self.bit_depth or 8 * kind.itemsize) - 1

    def with_settings(self, given: InputSettings) -> SensorInfo:
        """Return it with the bit depth and integration time of a configuration, where it sets them."""
        return replace(
            self,
            bit_depth=given.bit_depth or self.bit_depth,
            integration_time=given.integration_time or self.integration_time,
        )

    def write(self, store: RunStore) -> None:
        """Keep this in the store."""
        store.set_attributes("frames", {"sensor": asdict(self)})

    @classmethod
    def read(cls, store: RunStore) -> SensorInfo:
        """Return what ``ingest`` kept.

        Raises:
            StoreError: the run has no input yet.
        """
        content = store.attributes("frames").get("sensor")
        if content is None:
            raise StoreError(f"{store.path} has no input yet; run: pchem ingest {quoted(store.path)}")
        try:
            samples = tuple(Sample(**each) for each in content.get("samples", ()))
            camera = CameraFacts(**content.get("camera", {}))
            whole = content.get("whole")
            given = {"names": tuple(content["names"]), "samples": samples, "camera": camera}
            given["seen_limits"] = tuple(content.get("seen_limits", (None, None)))
            return cls(**{**content, **given, "whole": None if whole is None else tuple(whole)})
        except (TypeError, KeyError, AttributeError) as error:
            raise StoreError(f"{store.path}: frames is damaged ({error}); {store.cure('frames')}") from error
