"""Fates of electrons: added, delayed, moved, held, multiplied, or followed by others."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.wording import percent
from pchem_pipeline.effects.framework.compose import in_place
from pchem_pipeline.effects.framework.draws import OF_PIXEL, binomial_upper, regrouped, sent_to_neighbours
from pchem_pipeline.effects.framework.effect import DEPTH, Effect, Electrons, Factors, Plane, Ratio
from pchem_pipeline.effects.framework.neighbours import neighbour_words, neighbours
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR, POSSIBLE


class SpuriousCharge(Effect, tag="spurious_charge"):
    """Mean number of electrons added to every pixel of every frame.

    Clock-induced charge, glow of the amplifiers and leaking light add Poisson electrons to every frame
    (Janesick 2001, Scientific Charge-Coupled Devices, ch. 7; 1.5e-4 e-/px in Barak et al. 2022, SENSEI). The
    sum of Poisson electrons is Poisson: at one exposure time they are part of H.

    Signature: none: H is larger by as much.
    """

    plane = Plane.CHARGE
    title = "spurious (clock-induced) charge"
    source = (
        "Janesick 2001, Scientific Charge-Coupled Devices, ch. 7; "
        "Barak et al. 2022, Phys. Rev. Applied 17, 014022"
    )
    factors = Factors("electron number", "each pixel", "new in each frame")
    strength = "mean_e"
    untestable = (
        "sums of Poisson electrons are Poisson, so that it is part of H; a series of integration times would "
        "show it (the part of H independent of time)"
    )
    typical_values = ({"mean_e": 0.3},)
    mean_e: Electrons = Field(
        ge=0, le=1e6, description="mean number of spurious electrons per pixel and frame, e-"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, spurious ones included."""
        return np.asarray(values + context.random.poisson(np.full(values.shape, self.mean_e)))

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with this charge on top of H, which is then the exposure without it."""
        return model.with_added_exposure([[self.mean_e]], [[1.0]])


class ChargeLag(Effect, tag="charge_lag"):
    """Probability that an electron is read with the next frame instead of its own.

    An incomplete transfer out of the photodiode leaves each electron behind with probability f (Fossum and
    Hondongwa 2014; 0.1 e- and less in the pump-gate pixels of Ma et al. 2015). Poisson electrons that are
    delayed independently stay independent Poisson from frame to frame (Mirasol 1963).

    Signature: none at constant exposure: what is late in one frame is replaced, on average and in law, by
    what was late in the frame before.
    """

    plane = Plane.CHARGE
    title = "charge transfer lag"
    source = "Fossum and Hondongwa 2014, IEEE J. Electron Devices Soc. 2, 33; Mirasol 1963"
    factors = Factors("electron number", "each pixel", "with the charge of the frame before")
    strength = "fraction"
    reach_frames = 1
    untestable = (
        "in steady light, delayed charge leaves Poisson statistics unchanged; a bright frame followed by "
        "dark ones would show it"
    )
    typical_values = ({"fraction": 0.2},)
    fraction: Ratio = Field(
        ge=0, le=0.9, description="probability that an electron is delayed by one frame, no unit"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as read; the first frame gets nothing from before."""
        u = context.random.uniform(("frame", "y", "x"))
        late = binomial_upper(u.reshape(-1), values.reshape(-1), self.fraction).reshape(values.shape)
        result: AnyArray = values - late
        result[1:] += late[:-1]
        return result


class ChargeDiffusion(Effect, tag="charge_diffusion"):
    """Probability that an electron is collected by one of the four neighbours (each a quarter of it).

    Carriers released below the depleted region wander sideways before they are collected (Janesick 2001, ch.
    4). One that would leave the sensor at its edge stays. Poisson electrons that are moved independently stay
    independent Poisson (Kingman 1993, Poisson Processes, displacement theorem): in frames of one constant
    exposure this is invisible, and part of H.

    Signature: none: the map of H is blurred, and nothing tells a blurred map from a smooth one.
    """

    plane = Plane.CHARGE
    title = "charge diffusion"
    source = "Janesick 2001, Scientific Charge-Coupled Devices, ch. 4"
    factors = Factors("electron number", "each pixel", "with the charge of its neighbours")
    strength = "fraction"
    reach_rows = 1
    untestable = (
        "randomly moved Poisson electrons remain independent and Poisson, only the map of H changes; an "
        "edge, a spot or single X-rays would show it"
    )
    typical_values = ({"fraction": 0.2},)
    fraction: Ratio = Field(ge=0, le=0.9, description="probability that an electron moves, no unit")

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as collected."""
        result = values.copy()
        u = context.random.uniform(("frame", "y", "x"))
        (frame, y, x), (_, to_y, to_x) = sent_to_neighbours(values, u, self.fraction)
        row = context.rows[0] + to_y
        leaves = (row >= 0) & (row < context.shape[0]) & (to_x >= 0) & (to_x < context.shape[1])
        np.subtract.at(result, (frame[leaves], y[leaves], x[leaves]), 1)
        arrives = leaves & (to_y >= 0) & (to_y < values.shape[1])
        np.add.at(result, (frame[arrives], to_y[arrives], to_x[arrives]), 1)
        return result


class OpticalCrosstalk(Effect, tag="optical_crosstalk"):
    """Probability that an electron makes one more in one of the four neighbours (each a quarter of it).

    Electron luminescence does so in image sensors, avalanches in single-photon diode arrays (Rech et al.
    2008; Otte et al. 2009). Each pixel's count stays Poisson, of mean ``H + p`` times the mean of its
    neighbours' H, but neighbours are correlated: ``cov(K_i, K_j) = (p / 4) (H_i + H_j)``. Only the electrons
    themselves show it, not the readout. Photons that leave the sensor at its edge are lost. H is the exposure
    from outside.

    Signature: electron numbers of neighbours along x and y are correlated by about p / 2; the readout
    residual follows neither the neighbour's residual nor its electrons.
    """

    plane = Plane.CHARGE
    title = "optical crosstalk (luminescence)"
    source = "Rech et al. 2008, Opt. Express 16, 8381; Otte et al. 2009, Nucl. Instrum. Methods A 610, 105"
    factors = Factors("electron number", "each pixel", "with the charge of its neighbours")
    signature = ("space.x.kk", "space.y.kk")
    strength = "probability"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "residuals and neighbour's electrons: correlated by capacitance only",
        "exposure_flicker": "distant pixels: correlated by flicker only",
        "cosmic_rays": "longer exposures: tracks are rare and bright, crosstalk is frequent and single",
    }
    typical_values = ({"probability": 0.0112},)
    probability: Ratio = Field(
        ge=0, le=0.5, description="probability that an electron creates one in a neighbour, no unit"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, with those that came from the neighbours."""
        result = values.copy()
        u = context.random.uniform(("frame", "y", "x"))
        _, (frame, y, x) = sent_to_neighbours(values, u, self.probability)
        inside = (y >= 0) & (y < values.shape[1]) & (x >= 0) & (x < values.shape[2])
        np.add.at(result, (frame[inside], y[inside], x[inside]), 1)
        return result

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with a Poisson mean that holds what neighbours as bright as the pixel send."""
        return model.with_exposures([1.0], [1.0 + self.probability])


class BranchingCounts(Effect, tag="branching_counts"):
    """Mean number of further electrons that each electron makes: generalised Poisson electron numbers.

    Avalanches, hot carriers and luminescence that is absorbed in the pixel itself multiply electrons: every
    one, the secondary ones too, makes Poisson many (mean l) more. A primary one then becomes a cluster of
    Borel size, and Poisson many of them a generalised Poisson number (Consul and Jain 1973; Vinogradov 2012
    for silicon photomultipliers): ``P(k) = q (q + l k)^(k - 1) exp(-q - l k) / k!`` of mean ``q / (1 - l)``
    and variance ``q / (1 - l)^3``. H stays the mean number of electrons, ``q = H (1 - l)`` the primary ones.

    Signature: the score of the second Charlier polynomial is positive in all pixels, and per sample the same
    at every H; then that of the third; nothing in time, nothing between neighbours.
    """

    plane = Plane.CHARGE
    title = "branching (generalised Poisson) counts"
    source = "Consul and Jain 1973, Technometrics 15, 791; Vinogradov 2012, Nucl. Instrum. Methods A 695, 247"
    factors = Factors("electron number", "each pixel", "with the charge of the sample")
    signature = ("shape.C2.mean", "shape.C3.mean", "code.smooth")
    strength = "branching"
    separate: ClassVar[Mapping[str, str]] = {
        "overdispersed_counts": "several exposures: excess variance grows as H, by over-dispersion as H^2",
        "optical_crosstalk": "electron numbers of neighbours: correlated only by crosstalk (light that the "
        "sensor emits)",
        "exposure_flicker": "pixels of one frame: correlated by flicker only",
    }
    #: at half a percent, and at the tenth of a silicon photomultiplier
    typical_values = ({"branching": 0.0052},)
    branching: Ratio = Field(
        ge=0, le=0.5, description="mean number of secondary electrons per electron (l), no unit"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-; thinned by 1 - l first, so that the mean stays."""
        if self.branching == 0:
            return values.copy()
        u = context.random.uniform(("frame", "y", "x"))
        grow = -np.expm1(-self.branching)
        below = _borel_beyond_one(self.branching)

        def extra(v: FloatArray, index: IntArray) -> IntArray:
            return 1 + np.searchsorted(below, v)

        return regrouped(values, u, self.branching, lambda index: (self.branching, grow), extra)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with generalised Poisson electron numbers."""
        return model.with_counts("borel", self.branching)


@functools.lru_cache(maxsize=64)
def _borel_beyond_one(branching: float) -> FloatArray:
    """Return P(n <= 2 | n >= 2), P(n <= 3 | n >= 2), ... of a Borel number n, but for the last, 1."""
    mass, masses = branching * np.exp(-2.0 * branching), []
    n = 2
    while mass > 1e-17 * branching and n < 2000:
        masses.append(mass)
        # P(n) = exp(-l n) (l n)^(n - 1) / n!
        mass *= branching * np.exp(-branching + (n - 1) * np.log1p(1.0 / n))
        n += 1
    return np.asarray((np.cumsum(masses) / np.sum(masses))[:-1])


# nodes of a law of log-normal exposures, from so many times the variance of shot noise on
_NODES, _BEYOND = (3, 5, 7, 11, 17), (0.05, 0.3, 0.7, 1.3)


class OverdispersedCounts(Effect, tag="overdispersed_counts"):
    """Relative variance of the exposure of a pixel from frame to frame.

    Thermal light and speckle (Mandel 1959; Goodman 1985), dark-current blinking that is too fast to be
    resolved, and a jitter of each pixel's integration time mix Poisson laws: ``Var K = H + a H^2`` at a
    relative variance a of the exposure. One that is Gamma-distributed gives the negative binomial law
    (Greenwood and Yule 1920), which is drawn as what it also is: Poisson many clusters of logarithmic size
    (Quenouille 1949). One that is log-normal, a product of many small factors, is more skewed, which strong
    mixing shows.

    Signature: the score of the second Charlier polynomial is positive in all pixels, and per sample grows
    like H; nothing in time, nothing between neighbours, nothing in the readout channel.
    """

    plane = Plane.CHARGE
    title = "over-dispersed counts"
    source = "Mandel 1959, Proc. Phys. Soc. 74, 233; Goodman 1985, Statistical Optics, ch. 9"
    factors = Factors("light", "each pixel", "new in each frame")
    signature = ("shape.C2.mean", "shape.C2.slope", "code.smooth", "shape.C3.mean")
    strength = "relative_variance"
    separate: ClassVar[Mapping[str, str]] = {
        "branching_counts": "several exposures: excess variance grows as H^2, by branching as H",
        "exposure_flicker": "pixels of one frame: correlated by flicker only",
        "dark_current_rts": "slower frames and longer runs: blinking pixels are correlated in time",
    }
    #: at a = 0.0064, an exposure that jitters by 8 %
    typical_values = ({"relative_variance": 0.0064},)
    relative_variance: Ratio = Field(
        ge=0, le=1, description="variance of the exposure divided by its squared mean (a), no unit"
    )
    exposures: Literal["gamma", "lognormal"] = Field(
        default="gamma",
        description="how the exposures are distributed; gamma: electron numbers are negative binomial",
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, made of Poisson ones of mean ``context.exposure``."""
        assert context.exposure is not None  # the chain gives it from this plane on
        a, exposure = self.relative_variance, context.exposure
        if self.exposures == "lognormal":
            return self._thinned_or_added(values, exposure, context)
        u = context.random.uniform(("frame", "y", "x"))
        flat = exposure.reshape(-1)

        def law(index: IntArray) -> tuple[FloatArray, FloatArray]:
            x = np.maximum(a * flat[index], 1e-300)
            log = np.log1p(x)
            return np.maximum(1.0 - log / x, 0.0), np.maximum(1.0 - x / ((1.0 + x) * log), 0.0)

        def extra(v: FloatArray, index: IntArray) -> IntArray:
            return _logarithmic_beyond_one(v, a * flat[index])

        # both probabilities are below a H / 2
        return regrouped(values, u, (0.5 * a) * exposure, law, extra)

    def added_scatter_e(self, exposure: FloatArray) -> FloatArray:
        """Return the scatter of the exposure, e- rms: which electrons it moves differs from draw to draw."""
        return np.asarray(np.sqrt(self.relative_variance) * exposure)

    def _thinned_or_added(self, values: AnyArray, exposure: FloatArray, context: EffectContext) -> AnyArray:
        """Return Poisson numbers of the mean of each sample, made of those of the mean of all."""
        width = _width(self.relative_variance)
        normal = context.random.normal(("frame", "y", "x"))
        factor = np.exp(width * normal - 0.5 * width**2)
        u = context.random.uniform(("frame", "y", "x"), draw=1)
        lost = binomial_upper(
            u.ravel(), values.ravel().astype(np.int64), np.maximum(1.0 - factor, 0.0).ravel()
        )
        added = context.random.poisson(
            np.broadcast_to(exposure, values.shape) * np.maximum(factor - 1.0, 0.0), 2
        )
        return np.asarray(values - lost.reshape(values.shape) + added, values.dtype)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, as strong as the second Charlier polynomial has it.

        Both kinds of exposures where the third polynomial, in which they differ by ``a^2 H^3`` in all, would
        tell them apart.
        """
        found = super().estimate(evidence)
        exposure = evidence.maps.quanta_exposure[evidence.maps.usable]
        differ = np.sqrt(evidence.n_frames * np.nansum(exposure**3.0) / 6.0)
        apart = [one for one in found if one.relative_variance**2 * differ > CLEAR]
        return [*found, *(one.model_copy(update={"exposures": "lognormal"}) for one in apart)]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with negative binomial electron numbers, or mixed over log-normal exposures."""
        if self.exposures == "gamma":
            return model.with_counts("negative_binomial", self.relative_variance)
        # Gauss-Hermite in the logarithm, more nodes where exposures differ by more than shot noise does
        beyond = self.relative_variance * float(np.nanmax(maps.quanta_exposure, initial=0.0))
        number = _NODES[int(np.searchsorted(_BEYOND, beyond))]
        nodes, weights = np.polynomial.hermite_e.hermegauss(number)
        factors = np.exp(_width(self.relative_variance) * nodes)
        weights = weights / weights.sum()
        return model.with_exposures(weights, factors / (weights @ factors))


def _width(relative_variance: float) -> float:
    """Return the standard deviation of the logarithm of log-normal exposures."""
    return float(np.sqrt(np.log1p(relative_variance)))


def _logarithmic_beyond_one(v: FloatArray, x: FloatArray) -> IntArray:
    """Return n - 1 for logarithmic n >= 2, P(n) ~ theta^n / n with theta = x / (1 + x)."""
    theta = x / (1.0 + x)
    extra = np.ones(v.size, np.int64)
    mass = 0.5 * theta / (np.log1p(x) / theta - 1.0) if v.size else v
    active, below, n = np.arange(v.size), mass, 2
    while active.size and n < 100_000:
        more = v[active] > below
        active, below, mass, theta = active[more], below[more], mass[more], theta[more]
        extra[active] += 1
        mass = mass * theta * (n / (n + 1))
        below = below + mass
        keep = mass > 1e-17  # rounding must not keep the last few alive for ever
        active, below, mass, theta = active[keep], below[keep], mass[keep], theta[keep]
        n += 1
    return extra


# probability that the state of a trap goes back farther than the frames that are simulated for it
_RARE = 1e-6
_LIMITS = (0.02, 0.95)  # of a release, and the largest of a capture


class Trapping(Effect, tag="trapping"):
    """Chance that an empty trap of a pixel catches an electron of a sample.

    A trap holds one electron at most (Shockley and Read 1952). Where it is empty it takes one from a sample
    that has any with a chance c, whatever their number: the charge reaches it or does not (Massey et al.
    2010). Where it is full it gives the electron to a later sample, with a chance r in each. Its capacity
    makes it visible in frames of one exposure, other than a lag of electrons one by one
    (:class:`ChargeLag`).

    With the trap full or empty, s, sample t is ``K_t + s_t - s_{t+1}``. The trap is full in a share ``pi = a
    / (r + a)`` of the frames, ``a = c P(K >= 1)``, and its states of frames l apart are correlated by
    ``w^l`` with ``w = 1 - r - a``. From Poisson electrons of mean H follow the law of a sample, with ``m =
    (1 - pi) c``,

        ``P(k) = P(k; H) + m P(K >= 1) [P(k-1; H) - P(k; H)] + m [P(k+1; H) - P(k; H) 1(k >= 1)]``,

    its mean H, its variance ``H + 2 m P(K >= 2)`` and third factorial cumulant ``-6 m P(K >= 3)``, and the
    covariance of samples l frames apart, ``-r c P(K >= 2) w^(l-1)``. No charge is lost: the sum of all of
    these covariances is minus the excess of the variance.

    Signature: the electron numbers vary more than Poisson and are less skewed; successive ones are opposite,
    and so are those of some further frames, the less the longer apart. Nothing in the readout residual,
    nothing between neighbours, and block means are as even as those of Poisson electrons.
    """

    plane = Plane.CHARGE
    title = "charge trapping"
    source = (
        "Shockley and Read 1952, Phys. Rev. 87, 835; Massey et al. 2010, Mon. Not. R. Astron. Soc. 401, 371"
    )
    factors = Factors("electron number", "single pixels", "with the charge of the frame before")
    signature = ("time.lag1.charge.mean", "shape.C2.mean", "shape.C3.mean", "time.lag2.charge.mean")
    strength = "capture"
    separate: ClassVar[Mapping[str, str]] = {
        "overdispersed_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "over-dispersion does not",
        "branching_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "branching does not",
        "analog_memory": "dark frames after a bright one: traps release single electrons, memory fades "
        "within a frame",
        "dark_current_rts": "longer runs: the sum over many frames is Poisson with trapping, over-dispersed "
        "with dark-current RTS",
    }
    #: in all pixels, fast and slow, and in a tenth of them
    typical_values = (
        {"capture": 0.03, "release": 0.4},
        {"capture": 0.3, "release": 0.06},
        {"capture": 0.3, "release": 0.3, "fraction": 0.1},
    )
    capture: Ratio = Field(
        ge=0,
        le=_LIMITS[1],
        description="probability that an empty trap captures an electron of a sample that has any, no unit",
    )
    release: Ratio = Field(
        default=0.3,
        ge=_LIMITS[0],
        le=_LIMITS[1],
        description="probability per frame that a full trap releases its electron, no unit",
    )
    fraction: Ratio = Field(default=1.0, ge=0, le=1, description="share of the pixels with a trap, no unit")

    def history(self) -> int:
        """Return how many frames ago a trap was last filled or emptied whatever its state was, at most."""
        # chances above one half also make it change places, which leaves its state open
        known = min(self.release, 1.0 - abs(1.0 - self.release - self.capture))
        return math.ceil(math.log(_RARE) / math.log1p(-known)) if self.capture > 0 else 0

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as read: less what is caught, with what is released.

        A trap that was neither filled nor emptied for as long as :meth:`history` is taken for empty, so that
        it is the same whatever block is simulated.
        """
        u = context.random.uniform(("frame", "y", "x"))
        filled = (u > 1.0 - self.capture) & (values > 0)
        if self.fraction < 1:
            filled &= context.random.uniform(("y", "x"), OF_PIXEL[0]) < self.fraction
        emptied = u < self.release
        full = _states(filled, emptied, self.history())
        return values + full[:-1] - full[1:]

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the trap of which the autocovariances of the electron numbers are, in some pixels or in all.

        The squares of the first one tell in how many. Two traps of which one catches as often as the other
        releases have the same moments: that which is more often empty is meant.
        """
        time, maps = evidence.time, evidence.maps
        if time is None or not evidence.z.get("time.lag1.charge.mean", 0.0) < -POSSIBLE:
            return ()
        good = maps.usable & (maps.quanta_exposure > 0) & np.isfinite(time.lag_charge[:2]).all(axis=0)
        exposure, first = maps.quanta_exposure[good], time.lag_charge[0][good].astype(np.float64)
        some = -np.expm1(-exposure)
        # the expected electron number answers to the electrons by Var(k) / H
        answer = (some - exposure * np.exp(-exposure)) * (evidence.charge_std[good] / exposure) ** 2
        mean = -float(answer @ first / (answer @ answer))
        if not mean > 0.0:
            return ()
        left = float(np.clip(-(answer @ time.lag_charge[1][good]) / (answer @ answer) / mean, 0.0, 0.95))
        weight = answer**2 / float((answer**4).sum())
        squares = float(weight @ (first**2 - 1.0 / time.n_pairs))
        beyond = squares - mean**2 > CERTAIN * (2.0 * float(weight @ weight)) ** 0.5 / time.n_pairs
        shares = (mean**2 / squares, 1.0) if beyond else (1.0,)
        return [cls._with(mean / share, 1.0 - left, float(some.mean()), share) for share in shares]

    @classmethod
    def _with(cls, product: float, total: float, some: float, fraction: float) -> Self:
        """Return it with the product ``r c`` of its chances and their sum ``r + c P(K >= 1)``."""
        low, high = _LIMITS
        release = 0.5 * (total + max(total**2 - 4.0 * product * some, 0.0) ** 0.5)
        capture = min((total - release) / some, high)
        return cls(capture=capture, release=min(max(release, low), high), fraction=fraction)

    def details(self) -> tuple[str, ...]:
        """Return the chance of a release, and the share of the pixels where not all have a trap."""
        return ("release", "fraction") if 0.0 < self.fraction < 1.0 else ("release",)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with trapped electrons; the same one where only some pixels have a trap."""
        if self.fraction < 1:
            return model
        return model.with_counts("trapped", self.chance(np.nan_to_num(maps.quanta_exposure)))

    def chance(self, exposure: FloatArray) -> FloatArray:
        """Return m, the chance that a sample with electrons loses one, for exposures H, e-."""
        some = -np.expm1(-exposure)
        return np.asarray(self.capture * self.release / (self.release + self.capture * some))


def _states(filled: BoolArray, emptied: BoolArray, history: int) -> IntArray:
    """Return whether traps are full before and behind each frame, (frame + 1, y, x), 0 or 1.

    In the frames ``filled`` an empty trap is filled, in those ``emptied`` a full one is emptied.
    """
    start = np.zeros((1, *filled.shape[1:]), np.bool_)
    frame = np.arange(filled.shape[0] + 1)[:, None, None]
    # where both happen it changes its state; else it is known afterwards
    changes = np.concatenate([start, np.logical_xor.accumulate(filled & emptied, axis=0)])
    known = np.concatenate([start, filled ^ emptied])
    last = np.maximum.accumulate(np.where(known, frame, 0), axis=0)
    then = np.take_along_axis(np.concatenate([start, filled]) ^ changes, last, axis=0)
    full = (then ^ changes) & (last > 0) & (frame - last < history)
    return np.asarray(full, np.int64)


#: What happens to electrons: some that have others in their sample are lost or moved, or each brings others,
#: or all of a sample are lost together.
Fate = Literal["lost", "moved", "followed", "emptied"]
_MOST_LATER = 0.9  # others that an electron brings to later frames, beyond which there is no steady number
_EMPTY = 1e-9  # of its exposure, what a sample has that loses all of its electrons


class ElectronMode(Section):
    """Something that happens to electrons, in proportion to their number or to that of their pairs.

    Lost, moved: each electron with a chance for every other one in its sample. Followed: each brings a
    Poisson number of others, and those that come to a later frame bring others themselves. Emptied: a sample
    loses all of its electrons.
    """

    fate: Fate = Field(
        description="lost, moved (to place), followed (by further electrons, at place), or emptied (all lost)"
    )
    weight: float = Field(default=1.0, gt=0, description="relative frequency, no unit")
    place: tuple[int, int, int] = Field(
        default=(0, 0, 0), description="distance from the electron's sample: frames later, rows, columns"
    )

    @model_validator(mode="after")
    def _of_the_future(self) -> Self:
        if self.place[0] < 0 or (self.fate == "moved") > any(self.place):
            raise ValueError("place: give this frame or a later one; moved electrons need another sample")
        if self.fate == "emptied" and any(self.place):
            raise ValueError("place: leave it out with emptied")
        return self

    def describe(self, chance: float) -> str:
        """Return in words how the numbers vary together, with a chance (or a mean number)."""
        if self.fate == "emptied":
            return f"{percent(chance)} of the samples have no electrons"
        where = neighbour_words(self.place) if any(self.place) else "the same sample"
        if self.fate == "followed":
            return f"{chance:+.2g} electrons in {where} per electron"
        more = f", to {where}" if self.fate == "moved" else ""
        return f"a sample of k electrons loses {chance:.2g} k (k - 1) of them{more}"


class EmpiricalElectrons(Effect, tag="empirical_electrons"):
    """Electrons that are lost, one by one or together, moved or followed by others, as often as is measured.

    To first order in its strength, whatever electrons do to each other shows in two things only: how far
    their number varies more or less than Poisson, and how numbers of neighbours and of successive frames go
    together (Cox and Isham 1980, Point processes, on factorial cumulants). The simplest events that make
    both describe the samples; nothing is said about why.

    Signature: none of its own; it is measured where the data disagree with all that is known, and describes
    the law of the electron numbers without a name for what makes it so.
    """

    plane = Plane.CHARGE
    title = "empirical electron-number correlations"
    source = "Cox and Isham 1980, Point processes (factorial cumulants)"
    strength = "chance"
    empirical = True
    #: electrons of which each hundredth brings another one to the next frame
    typical_values = ({"chance": 0.01, "modes": (ElectronMode(fate="followed", place=(1, 0, 0)),)},)
    chance: Ratio = Field(ge=0, le=0.5, description="largest probability or mean number (weight 1), no unit")
    modes: tuple[ElectronMode, ...] = Field(
        min_length=1, max_length=8, description="what happens: its `fate`, `place` and relative `weight`"
    )

    @property
    def measured_parts(self) -> int:
        """How many modes there are."""
        return len(self.modes)

    def halo(self) -> int:
        """Return how far electrons come across rows, px."""
        return max(abs(mode.place[1]) for mode in self.modes) * (DEPTH if self.history() else 1)

    def history(self) -> int:
        """Return how many frames before it matter."""
        return DEPTH * max(mode.place[0] for mode in self.modes)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, without those that go and with those that come."""
        own, chance = values.astype(np.int64), self._chances()
        for number, mode in enumerate(self.modes):
            if mode.fate != "followed":
                u = context.random.uniform(("frame", "y", "x"), number)
                emptied = mode.fate == "emptied"
                gone = np.where(u < chance[number], own, 0) if emptied else _gone(own, u, chance[number])
                own = own - gone + (_arrived(gone, mode.place) if mode.fate == "moved" else 0)
        followed = [n for n, mode in enumerate(self.modes) if mode.fate == "followed"]
        found = own
        for _ in range(DEPTH if self.history() else 1):
            before, found = found, own
            for number in followed:
                place = self.modes[number].place
                source = _arrived(before if place[0] else own, place)
                mean = np.asarray(chance[number] * source, np.float64)
                found = np.asarray(found + context.random.poisson(mean, number))
        return found.astype(values.dtype)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law of what is left, and of as many more as come; H is the exposure without all that.

        Those that come are taken for as independent as those that are there, and those that were moved for
        as many as those that come in their place.
        """
        here = later = 0.0
        for mode, chance in zip(self.modes, self._chances(), strict=True):
            if mode.fate == "lost":
                model = model.with_counts("lost", chance)
            elif mode.fate == "emptied":
                model = model.with_exposures((chance, 1.0 - chance), (_EMPTY, 1.0))
            elif mode.fate == "followed" and mode.place[0]:
                later += chance
            elif mode.fate == "followed":
                here += chance
        return model.with_exposures((1.0,), ((1.0 + here) / max(1.0 - later, 1.0 - _MOST_LATER),))

    def _chances(self) -> list[float]:
        """Return the chance, or mean number, of each mode."""
        largest = max(mode.weight for mode in self.modes)
        return [self.chance * mode.weight / largest for mode in self.modes]

    def describe(self) -> str:
        """Return what is known of it."""
        parts = [mode.describe(chance) for mode, chance in zip(self.modes, self._chances(), strict=True)]
        return f"electron numbers{in_place(self)} are not independent ({'; '.join(parts)})"


def _gone(electrons: IntArray, u: FloatArray, chance: float) -> IntArray:
    """Return how many electrons of each sample go, each with a chance for every other one."""
    gone = np.zeros(electrons.shape, np.int64)
    here = np.nonzero(electrons > 1)
    k = electrons[here]
    gone[here] = binomial_upper(u[here], k, np.minimum(chance * (k - 1), 0.99))
    return gone


def _arrived(electrons: IntArray, place: tuple[int, int, int]) -> IntArray:
    """Return how many electrons come from the samples of which each is at a place, 0 from beyond the edge."""
    if not any(place):
        return electrons
    source, known = neighbours(electrons, (-place[0], -place[1], -place[2]))
    return np.where(known, source, 0)
