"""The mass of codes under any law of a pixel's samples, its slopes, likelihoods and drawn histograms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import FloatArray, IndexArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.law import mass_numba
from pchem_pipeline.model.law.cells_numba import CORE, EXACT, NEAR
from pchem_pipeline.model.law.inputs import pack, satellites_of
from pchem_pipeline.model.law.parameters import Parameters, columns_of, usable_pixels
from pchem_pipeline.model.law.replaced_samples import ReplacedSamples
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Mass of an occupied code, at least.
LEAST_SEEN = 1e-60

#: Pixels whose masses are held at a time, and codes where pixels of the same number of codes come together.
_AT_ONCE, _CODES_AT_ONCE = 256, 1 << 17
# mass of a cell that tells nothing: a difference of two tails that are alike, whose slopes are left over
_LEAST_TOLD = 1e-15


def code_ranges(
    model: SampleLaw, maps: Parameters, satellites: tuple[ArrayLike, ArrayLike] | None = None
) -> tuple[IntArray, IntArray]:
    """Return the first and last code that pixels show, DN, shape (n,); 0 and -1 without usable parameters.

    Arguments as of :func:`sample_mass`.
    """
    columns = columns_of(maps)
    n = columns.shape[0]
    columns[~usable_pixels(*columns.T)] = np.nan
    reach = np.empty((n, 2), np.int64)
    mass_numba.find_reach(columns, satellites_of(satellites, n), pack([model], n), reach)
    return reach[:, 0], reach[:, 1]


def parts_of_similar_width(
    model: SampleLaw, maps: Parameters, limits: tuple[int, int] | None = None
) -> Iterator[tuple[IndexArray, IntArray, int]]:
    """Give pixels in parts whose codes take little memory: those with as many codes come together.

    Of all codes, or those between limits, DN. Pixels without usable parameters are in no part.

    Yields:
        Places of the pixels, the first code of each, DN, and how many codes the widest has.
    """
    low, high = code_ranges(model, maps)
    if limits is not None:
        low, high = np.maximum(low, limits[0]), np.minimum(high, limits[1])
    width = high - low + 1
    order = np.argsort(-width, kind="stable")
    order = order[width[order] > 0]
    while order.size:
        widest = int(width[order[0]])
        some, order = np.split(order, [max(1, _CODES_AT_ONCE // widest)])
        yield some, low[some], widest


def sample_mass(
    model: SampleLaw,
    maps: Parameters,
    codes: ArrayLike,
    *,
    satellites: tuple[ArrayLike, ArrayLike] | None = None,
    smallest: float = 0.0,
) -> FloatArray:
    """Return the probability of each code in each pixel, exact to the ends of the tails.

    Args:
        model: the law.
        maps: (H, g, mu, sigma) of n pixels (flattened where they are maps).
        codes: successive whole DN, shape (n_codes,) for all pixels alike or (n, n_codes).
        satellites: amplitude (e-) and weight of the pixels' free satellites; None: none.
        smallest: masses below it may be 0; 1e-50 takes a fraction of the time of all, 1e-17 less again.

    Returns:
        P(x), shape (n, n_codes); NaN where a parameter is.

    Raises:
        ValueError: if the codes do not increase by 1.
    """
    wanted = np.atleast_2d(np.asarray(codes, np.int64))
    if (np.diff(wanted, axis=1) != 1).any():
        raise ValueError("codes must increase by 1")
    columns = columns_of(maps)
    n = columns.shape[0]
    out = np.full((n, wanted.shape[1]), np.nan)
    if out.size:
        first = np.array(np.broadcast_to(wanted[:, 0], (n,)))
        stage = EXACT if smallest < 1e-50 else NEAR if smallest < 1e-17 else CORE
        none = np.empty((0, 4, out.shape[1]))
        mass_numba.mass_tile(first, columns, satellites_of(satellites, n), pack([model], n), stage, out, none)
    return out


def sample_slopes(
    model: SampleLaw, maps: Parameters, first: IntegerArray, n_codes: int
) -> tuple[FloatArray, FloatArray]:
    """Return the probability of successive codes down to 1e-50, (n, n_codes), and its slopes.

    From the first code of each pixel on, DN, shape (n,); the slopes are in log H, 1/g, mu and log sigma_R^2,
    shape (n, 4, n_codes). Other arguments as of :func:`sample_mass`.
    """
    columns = columns_of(maps)
    n = columns.shape[0]
    mass, slopes = np.full((n, n_codes), np.nan), np.full((n, 4, n_codes), np.nan)
    start = np.ascontiguousarray(first, np.int64)
    law = pack([model], n)
    mass_numba.mass_tile(start, columns, satellites_of(None, n), law, NEAR, mass, slopes)
    return mass, slopes


def sample_parabolas(
    model: SampleLaw,
    maps: Parameters,
    counts: IntegerArray,
    origin: IntegerArray,
    replaced: ReplacedSamples | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return log-likelihood, its slopes and Fisher's information of every pixel, NaN without parameters.

    Of histograms, (n, B), with the DN of bin 0, (n,), whose samples may have been replaced.

    Returns:
        Nats, shape (n,), samples of less than 1e-50 as of that; slopes in log H, 1/g, mu and log sigma_R^2,
        (n, 4); information in the same, (n, 4, 4).
    """
    columns, (n, width) = columns_of(maps), counts.shape
    value, score, information = np.empty(n), np.empty((n, 4)), np.empty((n, 4, 4))
    beyond = 0 if replaced is None else int(replaced.excess.max(initial=0))
    for begin in range(0, n, _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        mass, slopes = sample_slopes(model.of(some), list(columns[some].T), origin[some], width + beyond)
        if replaced is not None:
            mass, slopes = replaced.of(some).mass_and_slopes(mass, slopes)
        seen = np.maximum(mass, LEAST_SEEN)
        value[some] = (counts[some] * np.log(seen)).sum(axis=1)
        told = np.where(mass < _LEAST_TOLD, 0.0, mass)
        score[some], information[some] = score_and_information(slopes / seen[:, None], told, counts[some])
    return value, score, information


def score_and_information(
    log_slopes: FloatArray, mass: FloatArray, counts: IntegerArray
) -> tuple[FloatArray, FloatArray]:
    """Return the slopes of the log-likelihood of histograms, and Fisher's information of as many samples.

    From the slopes of the logarithm of the mass in a parameters, shape (n, a, B), the mass and the counts,
    (n, B); shapes (n, a) and (n, a, a).
    """
    expected = mass * counts.sum(axis=1, keepdims=True)
    score = np.einsum("nab,nb->na", log_slopes, counts)
    return score, (log_slopes * expected[:, None]) @ log_slopes.transpose(0, 2, 1)


class DrawnHistograms(NamedTuple):
    """Counts (n, B), DN of bin 0 (n,), and the true (H, g, mu, sigma), shape (n, 4)."""

    counts: NDArray[np.uint32]
    origin: IntArray
    truth: FloatArray


def draw_histograms(
    rng: np.random.Generator,
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    bias: ArrayLike,
    read_noise_e: ArrayLike,
    n_frames: int,
) -> DrawnHistograms:
    """Draw a histogram of every pixel from the exact mass of eq. (PCD_RV_definition), rounding included.

    The parameters are H >= 0, e-, g, e-/DN, mu, DN, and s_e with quantisation, e-, scalars or of shape (n,).

    Raises:
        ValueError: the read noise is below that of the rounding.
    """
    given = [np.asarray(a, np.float64) for a in (quanta_exposure, conversion_gain, bias, read_noise_e)]
    exposure, gain, offset, noise = (np.ravel(a) for a in np.broadcast_arrays(*given))
    if (noise**2 < QUANTISATION_VARIANCE * gain**2).any():
        raise ValueError("the read noise is below the rounding noise")
    origin = np.floor(offset - 9 * noise / gain).astype(np.int64) - 1
    width = np.ceil((exposure + 11 * np.sqrt(exposure) + 12 * (exposure > 0) + 18 * noise) / gain) + 3
    x = origin[:, None] + np.arange(int(width.max()))
    truth = [exposure, gain, offset, noise / gain]
    mass = sample_mass(SampleLaw(), truth, x, smallest=1e-50)
    counts = rng.multinomial(n_frames, mass / mass.sum(axis=1, keepdims=True))
    return DrawnHistograms(counts.astype(np.uint32), origin, np.stack(truth, axis=1))
