"""The law of one pixel's samples once the PCD has grown: what replaces Poisson, the comb and the Gaussian.

The PCD is ``x = round(mu + (K + R) / g)`` with Poisson K and Gaussian R (Hendrickson et al. 2023, eq.
PCD_RV_definition). Effects change the law of K, the levels that it maps to, the noise around them, and the
codes. A :class:`SampleLaw` says all that for a batch of n pixels; each effect of a run's model adds its
part with :meth:`~pchem_pipeline.effects.framework.effect.Effect.sample_law`, and the fit of (H, g, mu, sigma)
uses the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray

CountLaw = Literal["poisson", "negative_binomial", "borel", "trapped", "lost"]
#: A number of all pixels, or one of each, shape (n,).
Number = float | FloatArray


@dataclass(frozen=True)
class SampleLaw:
    """The mass of code x given (H, g, mu, sigma) of a pixel.

    ``P(x) = sum_bj w_b u_j sum_k P(k; H f_b + d_j) sum_l v_l [Phi((e_{x+1} - m) / s) - Phi((e_x - m) / s)]``
    with mean ``m = mu + (level_scale k (1 + curvature (k - 1) / 2) + level_shift_e + shift_e_l) / g +
    shift_dn_l + shift_sigma_l sigma_R``, variance ``s^2 = (width_l sigma_R)^2 + [extra_variance_e2 +
    variance_per_electron k + variance_per_electron2 k^2] / g^2 + extra_variance_dn2``, where sigma_R^2 =
    sigma^2 - 1/12 is the analog part in DN^2 (cells are integrated exactly, so quantisation adds itself), and
    code edges ``e_x = x - 1/2 + edge_shift(x)``; what lies beyond ``clip_low``, ``clip_high`` counts there. A
    share of the samples may be outliers, anywhere.

    Where below no shape is given there is one number for all pixels, unless the law was :meth:`joined` from
    laws of groups: then there is a row for each.

    Attributes:
        law: law of the electron number; its mean is H, but where electrons are lost.
        dispersion: negative binomial: a in Var K = H + a H^2; borel (generalised Poisson): l in Var K =
            H / (1 - l)^2 at mean H; trapped: chance m that a sample with electrons loses one to a trap, which
            gives as many back to other samples, Var K = H + 2 m P(K >= 2; H); lost: chance c of each electron
            for every other one in its sample, of H electrons on average before, E K = H - c H^2; no unit.
        exposure_weights, exposure_factors: discrete mixture of exposures H f_b, shape (m,) each; weights sum
            to 1, and the mean factor is 1 where H is the exposure of all that the samples hold.
        added_exposure, added_weights: discrete mixture of exposures d_j beside H, e-, >= 0, and its weights
            u_j, shape (n or 1, j) each; weights sum to 1 along j.
        level_scale: DN per electron of the comb relative to 1/g, shape (n,) or (1,).
        level_shift_e: shift of all levels, e-, shape (n,) or (1,).
        curvature: relative change of the step per electron, no unit.
        variance_per_electron, variance_per_electron2: e-^2 per electron and per electron squared.
        extra_variance_e2, extra_variance_dn2: variance that no parameter of the pixel holds, e-^2 and DN^2,
            shape (n,) or (1,).
        satellite_weights, satellite_shift_e, satellite_shift_dn, satellite_shift_sigma, satellite_width:
            components of the noise, shape (n or 1, l) each; weights sum to 1 along l.
        edge_first, edge_shift: shift of the lower edge of the codes from ``edge_first`` on, DN; 0 elsewhere.
            No edge may lie before the one below it.
        clip_low, clip_high: smallest and largest code that comes out, or None.
        outlier_share, outlier_codes: share of the samples that can be anything, evenly over so many codes:
            they then count for nothing in the fit (particle hits).
        free_satellites: amplitudes A, e-, of which one may be found in a pixel, with a weight q of its own;
            the fit tries each, refines the best, and keeps it where the likelihood rises enough. Empty: none.
        free_satellite_pattern: (shift in units of A, weight) of the levels beside the one at 0, which keeps
            1 - q; the weights sum to 1 and q multiplies them. The default is a trap read by correlated double
            sampling: -A, 0, +A with q/2, 1 - q, q/2.
        may_have_satellites: in which pixels they are looked for, shape (n,) or (1,).
        free_satellite_alarm: about the probability that a pixel without such levels is given some.
    """

    law: CountLaw | NDArray[np.str_] = "poisson"
    dispersion: Number = 0.0
    exposure_weights: FloatArray = field(default_factory=lambda: np.ones(1))
    exposure_factors: FloatArray = field(default_factory=lambda: np.ones(1))
    added_exposure: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    added_weights: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    level_scale: FloatArray = field(default_factory=lambda: np.ones(1))
    level_shift_e: FloatArray = field(default_factory=lambda: np.zeros(1))
    curvature: Number = 0.0
    variance_per_electron: Number = 0.0
    variance_per_electron2: Number = 0.0
    extra_variance_e2: FloatArray = field(default_factory=lambda: np.zeros(1))
    extra_variance_dn2: FloatArray = field(default_factory=lambda: np.zeros(1))
    satellite_weights: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    satellite_shift_e: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    satellite_shift_dn: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    satellite_shift_sigma: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))
    satellite_width: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    edge_first: int = 0
    edge_shift: FloatArray = field(default_factory=lambda: np.zeros(0))
    clip_low: int | FloatArray | None = None
    clip_high: int | FloatArray | None = None
    outlier_share: Number = 0.0
    outlier_codes: Number = 65536
    free_satellites: tuple[float, ...] = ()
    may_have_satellites: BoolArray = field(default_factory=lambda: np.ones(1, np.bool_))
    free_satellite_pattern: tuple[tuple[float, float], ...] = ((-1.0, 0.5), (1.0, 0.5))
    free_satellite_alarm: float = 1e-4

    @property
    def components(self) -> int:
        """Number of peaks that each electron number has, those that a fit tries in turn included."""
        mixed = (
            self.exposure_weights.shape[-1] * self.added_weights.shape[-1] * self.satellite_weights.shape[-1]
        )
        return int(mixed) + len(self.free_satellites) * len(self.free_satellite_pattern)

    @property
    def neutral(self) -> bool:
        """Whether this is the PCD itself, cells integrated exactly."""
        plain = SampleLaw()
        names = [each.name for each in fields(self)]
        return all(np.array_equal(getattr(self, name), getattr(plain, name)) for name in names)

    def of(self, pixels: IndexArray | BoolArray | slice) -> SampleLaw:
        """Return the law of some of the pixels (an index, a mask or a slice along n)."""
        rows = {name: getattr(self, name) for name in (*_PER_PIXEL, *_NUMBERS, *_TABLES, "edge_shift")}
        for name in rows.keys() - _PER_PIXEL:  # a row of each pixel only in laws that were joined
            if np.ndim(rows[name]) < (1 if name in _NUMBERS else 2):
                del rows[name]
        return replace(self, **{name: row[pixels] for name, row in rows.items() if row.shape[0] != 1})

    @classmethod
    def joined(cls, parts: Sequence[tuple[IndexArray, SampleLaw]], n: int) -> SampleLaw:
        """Return the law of n pixels from the pixels and the law of each group; a pixel is in one group.

        Raises:
            ValueError: groups look for different free satellites.
        """
        laws = [law for _, law in parts]
        found: dict[str, Any] = {}
        for name in (*_PER_PIXEL[:-1], *_NUMBERS, *_TABLES):  # of satellites below
            values = [np.asarray(_plain(name, getattr(law, name))) for law in laws]
            of_all = all(v.ndim == 0 or name in _TABLES or v.shape[0] == 1 for v in values)
            if of_all and all(_same(v, values[0]) for v in values):
                found[name] = getattr(laws[0], name)
                continue
            found[name] = _rows(name, [(pixels, v) for (pixels, _), v in zip(parts, values, strict=True)], n)
        found |= _joined_edges(parts, n)
        return cls(**found, **_joined_satellites(laws, [pixels for pixels, _ in parts], n))

    def mixed_with(
        self, other: SampleLaw, share: float, noise_dn2: FloatArray, step_dn: FloatArray
    ) -> SampleLaw:
        """Return the law of pixels of which a share of the samples follows another law, the others this one.

        Noise and exposures become mixtures, which is exact; so are outliers. Of all other numbers the mean is
        taken: right to first order in what the laws differ by, which holds for what is weak. Both are of the
        same n pixels, with analog noise sigma_R^2, DN^2, (n,), and steps 1/g, DN per electron, (n,).

        Raises:
            ValueError: the laws differ in their limits of the scale.
        """
        if (self.clip_low, self.clip_high) != (other.clip_low, other.clip_high):
            raise ValueError("a limit of the ADC in some frames only is not supported; exclude these frames")
        more = other.extra_variance_dn2 - self.extra_variance_dn2
        more = more + (other.extra_variance_e2 - self.extra_variance_e2) * step_dn**2
        found: dict[str, Any] = {"law": self.law if other.law == "poisson" else other.law}
        for name in _MEANS:
            found[name] = (1.0 - share) * getattr(self, name) + share * getattr(other, name)
        found |= _mixed_edges(self, other, share)
        names = [name for name in _PER_PIXEL if name.startswith("satellite")]
        mine, theirs = ({name: getattr(law, name) for name in names} for law in (self, other))
        if (np.abs(more) > _NARROW * noise_dn2).any():
            width = np.sqrt(np.maximum(1.0 + more / np.maximum(noise_dn2, 1e-9), 0.0))
            theirs["satellite_width"] = theirs["satellite_width"] * width[:, None]
            found["extra_variance_dn2"] = self.extra_variance_dn2
            found["extra_variance_e2"] = self.extra_variance_e2
        if any(not np.array_equal(mine[name], theirs[name]) for name in mine):
            found |= _united(mine, theirs, share, "satellite_weights")
        mine, theirs = ({name: getattr(law, name) for name in _TABLES} for law in (self, other))
        if any(not np.array_equal(mine[name], theirs[name]) for name in mine):
            found |= _united(mine, theirs, share, "exposure_weights")
        free = other if other.free_satellites else self
        found |= {name: getattr(free, name) for name in (*_SEARCHED, "may_have_satellites")}
        return replace(self, **found)

    def with_counts(self, law: CountLaw, dispersion: Number) -> SampleLaw:
        """Return a copy with another law of the electron number."""
        return replace(self, law=law, dispersion=dispersion)

    def with_exposures(self, weights: ArrayLike, factors: ArrayLike) -> SampleLaw:
        """Return a copy whose exposure is also mixed over ``factors`` (all products)."""
        w, f = np.asarray(weights, np.float64), np.asarray(factors, np.float64)
        return replace(
            self,
            exposure_weights=np.outer(self.exposure_weights, w).ravel(),
            exposure_factors=np.outer(self.exposure_factors, f).ravel(),
        )

    def with_added_exposure(self, exposure_e: ArrayLike, weights: ArrayLike) -> SampleLaw:
        """Return a copy whose pixels also get one of several exposures, (n, j) e- each (all sums)."""
        d, u = (np.atleast_2d(np.asarray(values, np.float64)) for values in (exposure_e, weights))
        return replace(
            self,
            added_exposure=_of_pairs(np.add, self.added_exposure, d),
            added_weights=_of_pairs(np.multiply, self.added_weights, u),
        )

    def with_noise(
        self,
        weights: ArrayLike,
        *,
        shift_e: ArrayLike = 0.0,
        shift_dn: ArrayLike = 0.0,
        shift_sigma: ArrayLike = 0.0,
        width: ArrayLike = 1.0,
    ) -> SampleLaw:
        """Return a copy whose noise is also mixed over components, (l,) or (n, l) each (all products)."""
        w = np.atleast_2d(np.asarray(weights, np.float64))

        def like(values: ArrayLike) -> FloatArray:
            return np.broadcast_to(np.asarray(values, np.float64), w.shape)

        return replace(
            self,
            satellite_weights=_of_pairs(np.multiply, self.satellite_weights, w),
            satellite_shift_e=_of_pairs(np.add, self.satellite_shift_e, like(shift_e)),
            satellite_shift_dn=_of_pairs(np.add, self.satellite_shift_dn, like(shift_dn)),
            satellite_shift_sigma=_of_pairs(np.add, self.satellite_shift_sigma, like(shift_sigma)),
            satellite_width=_of_pairs(np.multiply, self.satellite_width, like(width)),
        )

    def with_variance(
        self,
        *,
        dn2: ArrayLike = 0.0,
        e2: ArrayLike = 0.0,
        per_electron: Number = 0.0,
        per_electron2: Number = 0.0,
    ) -> SampleLaw:
        """Return a copy with more variance, scalar or (n,): DN^2, e-^2, e-^2 per electron and its square."""
        return replace(
            self,
            variance_per_electron=self.variance_per_electron + per_electron,
            variance_per_electron2=self.variance_per_electron2 + per_electron2,
            extra_variance_dn2=self.extra_variance_dn2 + np.atleast_1d(np.asarray(dn2, np.float64)),
            extra_variance_e2=self.extra_variance_e2 + np.atleast_1d(np.asarray(e2, np.float64)),
        )

    def with_levels(
        self, *, scale: ArrayLike = 1.0, shift_e: ArrayLike = 0.0, curvature: float = 0.0
    ) -> SampleLaw:
        """Return a copy with a comb stretched by ``scale``, moved by ``shift_e`` e-, and bent.

        The first two are scalar or (n,); ``curvature`` is a relative change of the step per electron.
        """
        return replace(
            self,
            curvature=self.curvature + curvature,
            level_scale=self.level_scale * np.atleast_1d(np.asarray(scale, np.float64)),
            level_shift_e=self.level_shift_e + np.atleast_1d(np.asarray(shift_e, np.float64)),
        )

    def with_edges(self, first: int, shift: ArrayLike) -> SampleLaw:
        """Return a copy whose lower code edges from ``first`` on are shifted further, by DN, shape (m,)."""
        more = np.asarray(shift, np.float64)
        if self.edge_shift.size == 0:
            return replace(self, edge_first=first, edge_shift=more)
        low = min(first, self.edge_first)
        high = max(first + more.size, self.edge_first + self.edge_shift.size)
        both = np.zeros(high - low)
        both[first - low : first - low + more.size] += more
        both[self.edge_first - low : self.edge_first - low + self.edge_shift.size] += self.edge_shift
        return replace(self, edge_first=low, edge_shift=both)

    def with_clip(self, low: int | None = None, high: int | None = None) -> SampleLaw:
        """Return a copy with codes cut to ``low`` .. ``high``, and to the limits that there are."""
        lows = [c for c in (low, self.clip_low) if c is not None]
        highs = [c for c in (high, self.clip_high) if c is not None]
        return replace(self, clip_low=max(lows, default=None), clip_high=min(highs, default=None))

    def between(self, low: int | FloatArray | None, high: int | FloatArray | None) -> SampleLaw:
        """Return a copy with limits of the codes where it has none of its own."""
        low = low if self.clip_low is None else self.clip_low
        return replace(self, clip_low=low, clip_high=high if self.clip_high is None else self.clip_high)

    def with_outliers(self, share: float, codes: int = 65536) -> SampleLaw:
        """Return a copy in which a share of the samples may lie anywhere among so many codes."""
        return replace(self, outlier_share=share, outlier_codes=codes)

    def with_free_satellites(
        self,
        amplitudes_e: Sequence[float],
        *,
        pattern: Sequence[tuple[float, float]] | None = None,
        alarm: float = 1e-4,
    ) -> SampleLaw:
        """Return a copy that looks in every pixel for satellites of one of these amplitudes."""
        return replace(
            self,
            free_satellites=tuple(float(a) for a in amplitudes_e),
            free_satellite_pattern=self.free_satellite_pattern if pattern is None else tuple(pattern),
            free_satellite_alarm=alarm,
        )


#: Fields that may have one row per pixel.
_PER_PIXEL = (
    "added_exposure",
    "added_weights",
    "level_scale",
    "level_shift_e",
    "extra_variance_e2",
    "extra_variance_dn2",
    "satellite_weights",
    "satellite_shift_e",
    "satellite_shift_dn",
    "satellite_shift_sigma",
    "satellite_width",
    "may_have_satellites",
)
#: Fields that have one number for all pixels, unless laws were joined.
_NUMBERS = (
    "law",
    "dispersion",
    "curvature",
    "variance_per_electron",
    "variance_per_electron2",
    "clip_low",
    "clip_high",
    "outlier_share",
    "outlier_codes",
)
#: Fields that have one row for all pixels, and no axis for them, unless laws were joined.
_TABLES = ("exposure_weights", "exposure_factors")
#: Fields of the satellites that a fit looks for.
_SEARCHED = ("free_satellites", "free_satellite_pattern", "free_satellite_alarm")
#: What rows are filled up with where one pixel has fewer components than another.
_FILL = {"satellite_width": 1.0, "exposure_factors": 1.0}
#: Numbers of which the mean over the frames is taken where these differ.
_MEANS = (
    "dispersion",
    "curvature",
    "variance_per_electron",
    "variance_per_electron2",
    "extra_variance_e2",
    "extra_variance_dn2",
    "level_scale",
    "level_shift_e",
    "outlier_share",
)
# variance in some of the frames, relative to the noise, above which it is more than a mean variance: the
# fourth cumulant that this misses is then 1e-3 of the squared variance
_NARROW = 0.02


def _of_pairs(operation: np.ufunc, mine: FloatArray, theirs: FloatArray) -> FloatArray:
    """Return sums or products of all pairs of columns of two tables, row by row."""
    both = operation(mine[:, :, None], theirs[:, None, :])
    return np.ascontiguousarray(both.reshape(both.shape[0], -1))


def _same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Return whether arrays are equal; no limit is the same as no limit."""
    return one.dtype.kind == other.dtype.kind and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def _plain(name: str, value: Any) -> Any:
    """Return a limit of the scale as a number: NaN for none."""
    return np.nan if value is None and name.startswith("clip") else value


def _rows(name: str, parts: Sequence[tuple[IndexArray, NDArray[Any]]], n: int) -> NDArray[Any]:
    """Return a row for each of n pixels from those of groups, as long as the longest."""
    values = [each[None] if name in _TABLES and each.ndim == 1 else each for _, each in parts]
    most = max((each.shape[1] for each in values if each.ndim == 2), default=None)
    found: NDArray[Any] = np.full((n,) if most is None else (n, most), _FILL.get(name, 0.0))
    if name == "law":
        found = np.full(n, "negative_binomial")
    for (pixels, _), each in zip(parts, values, strict=True):
        if most is None:
            found[pixels] = each
        else:
            found[pixels, : each.shape[1]] = each
    return found


def _joined_edges(parts: Sequence[tuple[IndexArray, SampleLaw]], n: int) -> dict[str, Any]:
    """Return the shifts of the code edges of groups of pixels, from one code on."""
    laws = [law for _, law in parts]
    first = laws[0]
    if all(law.edge_first == first.edge_first and _same(law.edge_shift, first.edge_shift) for law in laws):
        return {"edge_first": first.edge_first, "edge_shift": first.edge_shift}
    some = [law for law in laws if law.edge_shift.size]
    low = min(law.edge_first for law in some)
    shifts = np.zeros((n, max(law.edge_first + law.edge_shift.size for law in some) - low))
    for pixels, law in parts:
        place = law.edge_first - low
        if law.edge_shift.size:
            shifts[pixels, place : place + law.edge_shift.size] = law.edge_shift
    return {"edge_first": low, "edge_shift": shifts}


def _joined_satellites(laws: Sequence[SampleLaw], pixels: Sequence[IndexArray], n: int) -> dict[str, Any]:
    """Return which free satellites groups of pixels look for, and which pixels do."""
    looking = [law for law in laws if law.free_satellites]
    if not looking:
        return {}
    if len({(law.free_satellites, law.free_satellite_pattern) for law in looking}) > 1:
        raise ValueError("two kinds of free satellites in one model; keep one of the effects")
    where = np.zeros(n, np.bool_)
    for law, some in zip(laws, pixels, strict=True):
        where[some] = bool(law.free_satellites)
    found = {name: getattr(looking[0], name) for name in _SEARCHED}
    return found | {"may_have_satellites": where}


def _mixed_edges(one: SampleLaw, other: SampleLaw, share: float) -> dict[str, Any]:
    """Return the mean shifts of the code edges of two laws."""
    mine = replace(SampleLaw(), edge_first=one.edge_first, edge_shift=(1.0 - share) * one.edge_shift)
    both = mine.with_edges(other.edge_first, share * other.edge_shift) if other.edge_shift.size else mine
    return {"edge_first": both.edge_first, "edge_shift": both.edge_shift}


def _united(
    mine: dict[str, FloatArray], theirs: dict[str, FloatArray], share: float, weights: str
) -> dict[str, Any]:
    """Return the components of both mixtures, weighted by their shares."""
    mine = mine | {weights: (1.0 - share) * mine[weights]}
    theirs = theirs | {weights: share * theirs[weights]}
    found = {}
    for name, own in mine.items():
        other = theirs[name]
        if own.ndim == 2:
            rows = max(own.shape[0], other.shape[0])
            own, other = (np.broadcast_to(each, (rows, each.shape[1])) for each in (own, other))
        found[name] = np.concatenate([own, other], axis=-1)
    return found
