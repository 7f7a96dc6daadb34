"""YAML section ``simulate``: the sensor to imagine and the frames to take with it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.effects.framework.registry import EffectList
from pchem_pipeline.simulate.distributions import ColumnPattern, Distribution, LogNormal, Normal
from pchem_pipeline.store.remote_path import local_path

ParameterName = Literal[
    "quanta_exposure", "dark_current", "conversion_gain", "dn_per_electron", "bias", "analog_read_noise_e"
]
#: The ways to give each of the four parameters.
_WAYS = (
    ("quanta_exposure", "dark_current"),
    ("dn_per_electron", "conversion_gain"),
    ("bias",),
    ("analog_read_noise_e",),
)


class Correlation(Section):
    """Rank correlation of two parameters over the pixels (Gaussian copula)."""

    between: tuple[ParameterName, ParameterName] = Field(
        description="names of two parameters in simulate.parameters"
    )
    rank: float = Field(gt=-1, lt=1, description="Spearman's rank correlation, no unit")

    @model_validator(mode="after")
    def _two_parameters(self) -> Self:
        if self.between[0] == self.between[1]:
            raise ValueError(f"correlation of {self.between[0]} with itself; name two parameters")
        return self


class HotPixels(Section):
    """A tail of pixels with a larger exposure than the rest."""

    fraction: float = Field(default=0.002, ge=0, le=1, description="fraction of pixels that are hot, no unit")
    multiplier: Distribution = Field(
        default=LogNormal(median=4.0, log_std=0.5, minimum=1.0),
        description="factor on the exposure of hot pixels, no unit",
    )


class ParameterSettings(Section):
    """How the parameters of the pixels are distributed over the sensor.

    Exposure and gain can each be given in one of two ways; giving the second one
    replaces the default of the first.
    """

    quanta_exposure: Distribution | None = Field(
        default=LogNormal(median=2.0, log_std=0.35, minimum=0.02),
        description="quanta exposure H, e- per frame; null if dark_current is given. A distribution is a "
        "kind with its numbers: constant (value), normal (mean, std), lognormal (median, log_std), gamma "
        "(mean, std), uniform or loguniform (low, high); each can have minimum, maximum and patterns of kind "
        "column, row, radial (amplitude) or gradient (amplitude, angle), relative or absolute",
    )
    dark_current: Distribution | None = Field(
        default=None, description="H / integration_time, e-/px/s, instead of quanta_exposure"
    )
    conversion_gain: Distribution | None = Field(
        default=None, description="conversion gain g, e-/DN, instead of dn_per_electron"
    )
    dn_per_electron: Distribution | None = Field(
        default=Normal(mean=11.0, std=0.9, minimum=8.0, maximum=14.0),
        description="1/g, DN/e-; null if conversion_gain is given",
    )
    bias: Distribution = Field(
        default=Normal(mean=100.0, std=4.0, patterns=(ColumnPattern(amplitude=1.0),)),
        description="bias mu, DN at zero electrons",
    )
    analog_read_noise_e: Distribution = Field(
        default=LogNormal(median=0.304, log_std=0.14, minimum=0.15, maximum=1.5),
        description="input-referred analog read noise sigma_R, e-, before rounding to DN",
    )
    correlations: tuple[Correlation, ...] = Field(
        default=(Correlation(between=("dn_per_electron", "analog_read_noise_e"), rank=-0.4),),
        description="rank correlations between parameters; all other pairs are independent",
    )
    hot_pixels: HotPixels = Field(default=HotPixels(), description="hot pixels")
    dead_fraction: float = Field(
        default=0.0, ge=0, le=1, description="fraction of pixels without any electron (H = 0), no unit"
    )
    stuck_fraction: float = Field(
        default=0.0, ge=0, le=1, description="fraction of pixels that always give the same DN, no unit"
    )

    @model_validator(mode="before")
    @classmethod
    def _second_way_replaces_first(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        data = dict(data)
        if data.get("dark_current") is not None:
            data.setdefault("quanta_exposure", None)
        if data.get("conversion_gain") is not None:
            data.setdefault("dn_per_electron", None)
            # the default correlation speaks of dn_per_electron; the same fact has the other sign for g
            data.setdefault(
                "correlations", ({"between": ("conversion_gain", "analog_read_noise_e"), "rank": 0.4},)
            )
        return data

    @model_validator(mode="after")
    def _each_given_once(self) -> Self:
        for first, second in _WAYS[:2]:
            if (getattr(self, first) is None) == (getattr(self, second) is None):
                raise ValueError(f"give exactly one of {first} and {second}, and null for the other")
        if self.dead_fraction + self.stuck_fraction + self.hot_pixels.fraction > 1:
            raise ValueError("dead_fraction + stuck_fraction + hot_pixels.fraction is above 1; lower them")
        return self

    @model_validator(mode="after")
    def _correlations_possible(self) -> Self:
        pairs = [frozenset(correlation.between) for correlation in self.correlations]
        for pair in pairs:
            for name in pair - self.given().keys():
                raise ValueError(f"correlations: unknown parameter {name}; use a given parameter")
            if pairs.count(pair) > 1:
                raise ValueError(f"correlation of {' and '.join(sorted(pair))} is given twice; keep one")
        if not _positive_definite(self.copula()):
            raise ValueError("correlations contradict each other (matrix not positive definite); weaken them")
        return self

    def given(self) -> dict[str, Distribution]:
        """Return the four distributions given, in the order exposure, gain, bias, read noise."""
        return {name: own for ways in _WAYS for name in ways if (own := getattr(self, name)) is not None}

    def copula(self) -> list[list[float]]:
        """Return the correlation matrix of the normals behind the four parameters, in the order of `given`.

        Spearman's rank correlation r needs normals correlated by 2 sin(pi r / 6).
        """
        names = list(self.given())
        matrix = [[float(i == j) for j in range(len(names))] for i in range(len(names))]
        for correlation in self.correlations:
            i, j = (names.index(name) for name in correlation.between)
            matrix[i][j] = matrix[j][i] = 2 * math.sin(math.pi * correlation.rank / 6)
        return matrix


def _positive_definite(matrix: list[list[float]]) -> bool:
    # Gaussian elimination by hand: numpy would make every import of the settings slow
    rows = [list(row) for row in matrix]
    for i, row in enumerate(rows):
        if row[i] <= 1e-9:
            return False
        for other in rows[i + 1 :]:
            factor = other[i] / row[i]
            other[:] = [b - factor * a for a, b in zip(row, other, strict=True)]
    return True


class SimulateSettings(Section):
    """Simulated camera frames (the model of the paper, eq. PCD_RV_definition, plus chosen effects)."""

    shape: tuple[int, int] = Field(default=(64, 64), description="rows and columns of the sensor, px")
    n_frames: int = Field(default=1000, ge=1, description="number of frames")
    seed: int = Field(default=1, ge=0, lt=2**63, description="random seed; same seed, same frames")
    sensor_seed: int | None = Field(
        default=None,
        ge=0,
        lt=2**63,
        description="random seed of the pixels' parameters; null: seed. With a fixed sensor_seed, another "
        "seed gives other frames of the same sensor",
    )
    integration_time: float = Field(default=4.87, gt=0, description="integration time per frame, s")
    bit_depth: int = Field(
        default=14, ge=1, le=24, description="bits of the ADC; largest DN 2**bit_depth - 1"
    )
    format: Literal["tiff", "fits", "hdf5", "npy", "raw", "zarr"] = Field(
        default="tiff", description="file format of the frames: tiff, fits, hdf5, npy, raw, zarr"
    )
    output: Annotated[Path, AfterValidator(local_path)] = Field(
        default=Path("frames"), description="folder for the frames and truth.npz"
    )
    frames_per_file: int | None = Field(
        default=None, ge=1, description="frames per file; null: all in one file"
    )
    truth_frames: int = Field(
        default=250, ge=0, description="number of first frames whose true electron numbers are stored"
    )
    sensor: Path | None = Field(
        default=None, description="npz file with the maps of a sensor (see pchem twin), instead of parameters"
    )
    scene: str | None = Field(
        default=None,
        description="exposure instead of the sensor's: a number, e- per frame, or a file with an image or a "
        "sequence of images in e- per frame (npy, TIFF, FITS); sequences are repeated",
    )
    parameters: ParameterSettings = Field(default=ParameterSettings(), description="parameters of the pixels")
    effects: EffectList = Field(
        default=(), description="effects added to the PCD, in the order in which they act within a plane"
    )

    @model_validator(mode="after")
    def _shape_positive(self) -> Self:
        if min(self.shape) < 1:
            raise ValueError(f"shape {list(self.shape)} has no pixels; give at least one row and column")
        if max(self.shape) > 65535:
            raise ValueError(f"shape {list(self.shape)} is larger than 65535 in one direction")
        return self
