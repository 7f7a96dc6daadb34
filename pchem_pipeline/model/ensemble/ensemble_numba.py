"""Compiled loops of the ensemble: what pixels add to the axes of the raw and of the NUCed data."""

from __future__ import annotations

import math

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel


@kernel(borrows=True)
def add_to_axes(
    values: FloatArray,
    codes: tuple[IntArray, IntArray, IntArray],
    forms: FloatArray,
    gain: FloatArray,
    bias: FloatArray,
    dn_start: int,
    nuced: tuple[float, int],
    raw: FloatArray,
    bins: FloatArray,
    moments: FloatArray,
    held: FloatArray,
) -> None:
    """Add values v of the codes of pixels, and quadratic forms v' C v, at whole DN and in NUCed bins.

    A code lies at the NUCed value ``(x - mu) g`` and falls into one bin as a whole; those of a pixel in one
    bin follow each other, and the form is that of their sum.

    Args:
        values: m for each code, one pixel after the other, shape (n_codes, m).
        codes: first code of each pixel, DN, places of its first values and after its last, shape (n,) each.
        forms: C of each pixel, shape (n, m, m), or (1, m, m) of all of them.
        gain: g, shape (n,).
        bias: mu, shape (n,).
        dn_start: first DN of the raw axis.
        nuced: width of a NUCed bin, e-, and number of the first.
        raw: in and out, sums of the first value and of the forms, shape (2, n_dn).
        bins: likewise, one more bin at either end for what lies beyond, shape (2, n_bins + 2).
        moments: in and out, sums of the first value times the NUCed value and its square, shape (2,).
        held: working memory, all 0, shape (m,).
    """
    width, start = nuced
    last = bins.shape[1] - 1
    for p in range(gain.size):
        first, begin, end = codes[0][p], codes[1][p], codes[2][p]
        form, place = forms[min(p, forms.shape[0] - 1)], 0
        for i in range(begin, end):
            seen = False
            for j in range(held.size):
                seen = seen or values[i, j] != 0
            if not seen:
                continue
            code = first + i - begin
            value = (code - bias[p]) * gain[p]
            if 0 <= code - dn_start < raw.shape[1]:
                raw[0, code - dn_start] += values[i, 0]
                raw[1, code - dn_start] += _form(values[i], form)
            moments[0] += values[i, 0] * value
            moments[1] += values[i, 0] * value * value
            here = int(min(max(math.floor(value / width + 0.5) - start + 1.0, 0.0), float(last)))
            if here != place:
                _release(held, form, bins[:, place])
                place = here
            for j in range(held.size):
                held[j] += values[i, j]
        _release(held, form, bins[:, place])


@kernel(borrows=True)
def _form(values: FloatArray, form: FloatArray) -> float:
    """Return v' C v."""
    total = 0.0
    for i in range(values.size):
        for j in range(values.size):
            total += form[i, j] * (values[i] * values[j])
    return total


@kernel(borrows=True)
def _release(held: FloatArray, form: FloatArray, out: FloatArray) -> None:
    """Add what was summed up of a bin, and its form, to the bin, and begin anew."""
    out[0] += held[0]
    out[1] += _form(held, form)
    for i in range(held.size):
        held[i] = 0.0
