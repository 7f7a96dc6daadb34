"""What the counts per code tell of the code edges, and of a bent or broken transfer curve.

If the lower edge of code c lies at ``c - 1/2 + d_c`` instead of ``c - 1/2``, the code's width is ``1 +
d_{c+1} - d_c`` and its counts grow in proportion (histogram test of ADCs, IEEE Std 1241). The smooth part
of d is taken for bias, gain and noise by the pixels' own fits, so only the rough part is looked at here.

A deviation ``delta(x)`` of the transfer curve moves the code edges by ``-delta``. The pixels' own fits take
up what looks like a change of their H, g, mu or sigma; what they leave is computed here to first order, for
a sample of pixels (the same projection as of an efficient score), summed over the codes and compared with
the residuals for sines of many periods and for breaks at many places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.effects.framework.evidence import CodeResiduals
from pchem_pipeline.effects.types import BoolArray, Evidence, FloatArray, IntArray, PixelMaps, SampleLaw

# fewest expected counts at which a relative residual is about normal
_FEWEST = 100.0
# fall of chi2 that one edge must bring, and most edges
_LEAST_GAIN = 18.0
_MOST_SHIFTS = 4


def usable_codes(code: CodeResiduals, *, most: int = 1 << 12) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the longest run of codes with counts enough: codes, relative residuals, expected counts."""
    every = code.first + np.arange(code.expected.size)
    # the extreme codes are where a limit piles counts up
    inside = (every > code.minimum) & (every < code.maximum)
    good = np.concatenate([[False], inside & (code.expected >= _FEWEST), [False]])
    runs = np.flatnonzero(np.diff(good.astype(np.int8))).reshape(-1, 2)
    if not runs.size:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    part = slice(*map(int, runs[np.diff(runs).argmax()]))
    if part.stop - part.start > most:  # the part with the most counts
        sums = np.cumsum(np.concatenate([[0.0], code.expected[part]]))
        begin = part.start + int((sums[most:] - sums[:-most]).argmax())
        part = slice(begin, begin + most)
    expected = np.asarray(code.expected[part], np.float64)
    codes = code.first + np.arange(part.start, part.stop)
    return codes, (code.observed[part] - expected) / expected, expected


def few_shifts(residuals: FloatArray, expected: FloatArray) -> FloatArray | None:
    """Return shifts of the edges, DN, shape (codes + 1,), if a few of them explain all that is rough.

    One edge after the other (matching pursuit); None if residuals ask for more than a few, or for none.
    """
    if residuals.size < 2:
        return None  # no edge between two codes
    shifts = np.zeros(residuals.size + 1)
    left = residuals.copy()
    # an edge moved up makes the code below it wider by as much as that above it narrower
    weight = np.concatenate([expected, [0.0]]) + np.concatenate([[0.0], expected])
    inner = slice(1, -1)
    for _ in range(_MOST_SHIFTS):
        pull = np.diff(np.concatenate([[0.0], left * expected, [0.0]]))
        gains = pull**2 / weight
        place = 1 + int(gains[inner].argmax())
        if gains[place] < _LEAST_GAIN:
            break
        shift = -pull[place] / weight[place]
        shifts[place] += shift
        left[place - 1] -= shift
        left[place] += shift
    if not shifts.any() or roughness(left, expected)[1] > 3.0:
        return None
    return shifts


def roughness(residuals: FloatArray, expected: FloatArray) -> tuple[float, float]:
    """Return the variance of independent edge shifts, DN^2, and how many standard errors it is above 0.

    Second differences ``(2 w_c - w_{c-1} - w_{c+1}) / sqrt(6)`` of the widths see nothing smooth; each has
    variance ``10/3`` of that of the edges, besides that of the counts.
    """
    if residuals.size < 8:
        return 0.0, 0.0
    second = (2 * residuals[1:-1] - residuals[:-2] - residuals[2:]) / np.sqrt(6.0)
    noise = (4 / expected[1:-1] + 1 / expected[:-2] + 1 / expected[2:]) / 6.0
    # optimal for weak shifts: weights of the squared inverse of the noise
    weights = noise**-2
    excess = float((weights * (second**2 - noise)).sum() / weights.sum())
    # squares of second differences of white noise: autocorrelations (4/6)^2 and (1/6)^2 at lags 1 and 2
    error = np.sqrt(2.0 * (1 + 2 * (16 + 1) / 36) * float((weights**2 * noise**2).sum())) / weights.sum()
    return max(excess, 0.0) * 0.3, excess / float(error)


def edge_shifts(residuals: FloatArray, expected: FloatArray, variance: float) -> FloatArray:
    """Return the most probable shifts of the edges, DN, shape (codes + 1,), given that of each variance.

    Least squares of the widths with a penalty on the shifts (the posterior mean of independent normal
    shifts): a tridiagonal system. The penalty leaves nothing that varies slowly.
    """
    n = residuals.size
    widths = np.diff(np.eye(n + 1), axis=0)
    weighted = widths * expected[:, None]
    system = widths.T @ weighted + np.eye(n + 1) / max(variance, 1e-12)
    return np.asarray(np.linalg.solve(system, weighted.T @ residuals), np.float64)


def code_range(maps: PixelMaps) -> tuple[int, int]:
    """Return first and last code that the pixels can give, 8 standard deviations included."""
    parts = np.stack([np.ravel(each) for each in maps.maps])
    exposure, gain, mu, noise = parts[:, np.isfinite(parts).all(axis=0)]
    if not mu.size:
        return 0, 0
    top = mu + (exposure + 8 * np.sqrt(exposure) + 8) / gain + 8 * noise
    return max(0, int(np.floor((mu - 8 * noise).min()))), int(np.ceil(top.max()))


_PIXELS = 256  # that stand for all: their windows of codes overlap many times
_PERIODS = 48  # sines that are tried, twice as many as are independent
_MOST_CODES = 1500  # memory: a square of so many numbers
_SHORTEST = 8.0  # DN; what changes faster is new from code to code
_END = 0.002  # share of the samples on either side that a break needs
# fall of chi2 by two coefficients at one of some 20 independent periods: p about 0.02
_LEAST_BEND_GAIN = 14.0
# knots of a curve, and the fall of chi2 that each further one must bring
_KNOTS, _PRICE = (5, 7, 9, 12, 16), 3.0
# share of the samples below its first knot, and above its last
_RARE = 0.002
# directions of the curve that are left at nothing: relative weight, squared standard errors
_WEAKEST, _DOUBT = 0.003, 4.0


@dataclass(frozen=True)
class Bend:
    """A deviation ``amplitude sin(2 pi x / period + phase)``: LSB, DN, rad."""

    amplitude: float
    period: float
    phase: float


@dataclass(frozen=True)
class Curve:
    """A smooth deviation by its values at knots: DN of the first, DN from one to the next, LSB."""

    first: float
    spacing: float
    values: FloatArray


@dataclass(frozen=True)
class Stitch:
    """A deviation ``slope (x - level) + step`` above a level, none below: DN per DN, DN, DN."""

    level: float
    slope: float
    step: float


@dataclass(frozen=True)
class CurveResponse:
    """What a small deviation of the transfer curve leaves in the counts per code."""

    edges: FloatArray  # lower edges of the codes and the upper one of the last, DN, (codes + 1,)
    response: FloatArray  # standard errors per DN of deviation at each edge, (codes, codes + 1)
    residuals: FloatArray  # those seen, standard errors, (codes,)
    expected: FloatArray  # counts per code, (codes,)

    @classmethod
    def of(cls, evidence: Evidence) -> CurveResponse | None:
        """Return that of the evidence; None of too few codes or without a usable pixel."""
        codes, residuals, expected = usable_codes(evidence.code, most=_MOST_CODES)
        pixels = _sample(evidence.maps)
        if codes.size < 16 or not pixels.bias.size:
            return None
        samples = evidence.n_frames * int(evidence.maps.usable.sum()) / pixels.bias.size
        response = _response(pixels, codes) * (samples / np.sqrt(expected))[:, None]
        return cls(np.append(codes, codes[-1] + 1) - 0.5, response, residuals * np.sqrt(expected), expected)

    def fits(self, deviations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return by how much pairs of deviations (kinds, 2, codes + 1) lower chi2, and their factors."""
        designs = np.einsum("ce,kje->kcj", self.response, deviations, optimize=True)
        factors = [np.linalg.lstsq(design, self.residuals, rcond=None)[0] for design in designs]
        left = [self.residuals - design @ each for design, each in zip(designs, factors, strict=True)]
        total = float((self.residuals**2).sum())
        return np.array([total - float((each**2).sum()) for each in left]), np.array(factors)

    def worth(self, gains: FloatArray, known: float = 0.0, least: float = _LEAST_BEND_GAIN) -> BoolArray:
        """Return which gains are more than a known one, and what chance and what else is amiss brings."""
        total = float((self.residuals**2).sum())
        left = np.maximum(1.0, (total - gains) / max(self.residuals.size - 6, 1))
        return np.asarray(gains - known > least * left)


def best_bend(evidence: Evidence) -> list[Bend]:
    """Return the sines that explain the residuals of the codes, the best first; none if none stands out."""
    curve = CurveResponse.of(evidence)
    if curve is None:
        return []
    share = np.cumsum(curve.expected) / curve.expected.sum()
    in_use = float(np.ptp(np.searchsorted(share, [0.01, 0.99])) + 1)  # DN of the middle 98 % of the samples
    periods = np.geomspace(_SHORTEST, max(2.0 * in_use, 4.0 * _SHORTEST), _PERIODS)
    turned = np.outer(2.0 * np.pi / periods, curve.edges)
    gains, factors = curve.fits(np.stack([np.sin(turned), np.cos(turned)], axis=1))
    worth = curve.worth(gains)
    found = []
    for place in np.argsort(-gains):
        if worth[place] and gains[place] >= gains[max(place - 2, 0) : place + 3].max():
            a, b = factors[place]
            found.append(Bend(float(np.hypot(a, b)), float(periods[place]), float(np.arctan2(b, a))))
    return found[:2]


def best_curve(evidence: Evidence) -> Curve | None:
    """Return the smooth curve through few knots that explains the residuals of the codes best.

    None where no curve explains more than the best sine does, and than its further knots bring by chance.
    """
    response = CurveResponse.of(evidence)
    if response is None:
        return None
    turned = [2.0 * np.pi / bend.period * response.edges for bend in best_bend(evidence)]
    waves = np.array([[np.sin(each), np.cos(each)] for each in turned]).reshape(-1, 2, response.edges.size)
    best, most = None, float(response.fits(waves)[0].max(initial=0.0))
    share = np.cumsum(response.expected) / response.expected.sum()
    first, last = response.edges[np.searchsorted(share, [_RARE, 1.0 - _RARE])]
    weight = np.sqrt(np.append(response.expected, 0.0) + np.append(0.0, response.expected))
    for number in _KNOTS:
        knots = np.linspace(first, last, number)
        values, gain = _fit_knots(response, through_knots(knots, np.eye(number), response.edges))
        # a sine has three numbers
        least = (_LEAST_BEND_GAIN + _PRICE * (number - 3)) if best is None else 2.0 * _PRICE
        if response.worth(np.array([gain]), most, least)[0]:
            # less a straight line, which bias and gain of the pixels take up
            deviation = through_knots(knots, values, response.edges)
            level = np.polynomial.Polynomial.fit(response.edges, deviation, 1, w=weight)
            best = Curve(float(knots[0]), float(knots[1] - knots[0]), values - level(knots))
            most = gain
    return best


def _fit_knots(response: CurveResponse, basis: FloatArray) -> tuple[FloatArray, float]:
    """Return values at the knots of a basis (codes + 1, knots), LSB, and by how much they lower chi2."""
    u, size, directions = np.linalg.svd(response.response @ basis, full_matrices=False)
    seen = u.T @ response.residuals
    kept = seen * np.clip(1.0 - _DOUBT / np.maximum(seen**2, 1e-9), 0.0, None)
    kept[size < _WEAKEST * size[0]] = 0.0  # above all a straight line, which bias and gain take up
    values = directions.T @ (kept / np.maximum(size, 1e-300))
    return values, float((seen**2 - (seen - kept) ** 2).sum())


def through_knots(knots: FloatArray, values: FloatArray, places: FloatArray) -> FloatArray:
    """Return natural cubic splines through values (knots, ...) at places; beyond the ends as at the ends."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(knots, values, bc_type="natural")
    return np.asarray(spline(np.clip(places, knots[0], knots[-1])), np.float64)


def best_stitch(evidence: Evidence) -> list[Stitch]:
    """Return the breaks that explain the codes best: a kink, and before it one with a step if better."""
    curve = CurveResponse.of(evidence)
    if curve is None:
        return []
    share = np.cumsum(curve.expected) / curve.expected.sum()
    inside = np.flatnonzero((share > _END) & (share < 1.0 - _END))
    # between two edges: which of them a step moves would otherwise depend on its sign
    levels = curve.edges[inside] - 0.5
    if not levels.size:
        return []
    beyond = curve.edges - levels[:, None]
    step = np.where(beyond >= 0.0, 1.0, 0.0)
    kink = beyond * step
    found: list[tuple[float, Stitch]] = []
    for pairs in (np.stack([kink, 0.0 * step], axis=1), np.stack([kink, step], axis=1)):
        gains, factors = curve.fits(pairs)
        best = int(gains.argmax())
        if curve.worth(gains)[best] and (not found or gains[best] > found[0][0] + _LEAST_BEND_GAIN / 2):
            found.insert(0, (gains[best], Stitch(float(levels[best]), *map(float, factors[best]))))
    return [stitch for _, stitch in found]


def _sample(maps: PixelMaps) -> PixelMaps:
    """Return pixels spread over the sensor, shape (n,), without the widest histograms."""
    some = maps.of(maps.usable & np.isfinite(np.stack(maps.maps)).all(axis=0))
    if not some.bias.size:
        return some
    widths = (some.quanta_exposure + 6.0 * np.sqrt(some.quanta_exposure)) / some.conversion_gain
    kept = np.flatnonzero(widths <= np.quantile(widths, 0.95))
    return some.of(kept[:: max(1, kept.size // _PIXELS)])


def _response(pixels: PixelMaps, codes: IntArray) -> FloatArray:
    """Return the change of the mass of the codes per DN of deviation at their edges, (codes, codes + 1).

    Summed over the pixels, each in a window of codes, with what their fits take up projected out.
    """
    from pchem_pipeline.model.law.mass import sample_slopes

    exposure, gain, bias, noise = pixels.maps
    sigma = np.sqrt(np.maximum(noise**2 - QUANTISATION_VARIANCE, 0.01))
    first = np.floor(bias - 5.0 * sigma).astype(np.int64)
    n_cells = int(np.ceil((10.0 * sigma + (exposure + 5.0 * np.sqrt(exposure) + 2.0) / gain).max()))
    masses, slopes = sample_slopes(SampleLaw(), pixels, first, n_cells)
    # a larger bias takes from each code what lies at its upper edge, and gives what lies at its lower one
    densities = np.pad(-np.cumsum(slopes[:, 2], axis=1), ((0, 0), (1, 0)))
    masses = np.maximum(masses, 1e-12)
    root = np.sqrt(masses)[:, :, None]
    # changes of the masses with H, mu, sigma, g, orthonormal under 1 / mass, (n, 4, cells)
    tangents = (np.linalg.qr(slopes.transpose(0, 2, 1) / root)[0] * root).transpose(0, 2, 1)
    total = np.zeros((codes.size + 2 * n_cells, codes.size + 2 * n_cells + 1))
    cells = np.arange(n_cells)
    begins = first - codes[0] + n_cells
    for begin, density, mass, tangent in zip(begins, densities, masses, tangents, strict=True):
        if not 0 <= begin <= total.shape[0] - n_cells:
            continue
        # a deviation at an edge moves the samples there into the upper cell
        taken = np.zeros((len(tangent), n_cells + 1))
        taken[:, :-1] = tangent / mass * density[:-1]
        taken[:, 1:] -= tangent / mass * density[1:]
        change = total[begin : begin + n_cells, begin : begin + n_cells + 1]
        change -= tangent.T @ taken
        change[cells, cells] += density[:-1]
        change[cells, cells + 1] -= density[1:]
    return total[n_cells:-n_cells, n_cells:-n_cells]
