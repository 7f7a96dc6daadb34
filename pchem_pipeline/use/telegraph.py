"""Telegraph jumps of single samples: the mean of the jump given the code, and the noise without it.

A pixel with a trap reads ``x = mu + (k + a + n) / g`` with a jump a of few levels (its free satellites). The
levels have the posterior ``P(a | x) = w_a P(x | a) / sum``, with P(x | a) the mass of the code under the
pixel's law with its bias moved by a. What is subtracted is E[a | x]: nothing where the levels are not told
apart, the jump where they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import CodeArray, Float32Array, FloatArray, IntArray, IntegerArray
from pchem_pipeline.model.electrons.electrons import KnownPixels, NumberTables, number_tables
from pchem_pipeline.model.law.parameters import columns_of
from pchem_pipeline.model.law.pcd import nearest_pcd


@dataclass(frozen=True)
class TelegraphJumps:
    """Jumps of the pixels with a trap.

    Attributes:
        pixels: their places in C order, (n,).
        tables: of their codes.
        jump: E[a | x] at each code of the tables, e-.
        noise: standard error of a sample less its jump at its own electron number, e-, (n,).
    """

    pixels: IntArray
    tables: NumberTables
    jump: Float32Array
    noise: FloatArray

    @classmethod
    def of(
        cls,
        minimum: IntegerArray,
        maximum: IntegerArray,
        prior: FloatArray | None,
        known: KnownPixels,
        parts: int = 1,
    ) -> TelegraphJumps:
        """Compute E[a | x] at the codes of the pixels with a trap; for the arguments see `number_tables`."""
        amplitude, weight = (np.asarray(each).ravel() for each in known.satellites or (np.zeros(1),) * 2)
        some = np.flatnonzero((amplitude > 0.0) & (weight > 0.0) & np.isfinite(known.exposure))
        known, amplitude, weight = known.of(some), amplitude[some], weight[some]
        columns, exposure = columns_of(known.parameters), None if prior is None else prior.ravel()[some]
        # noise is an expectation over all codes that may come, not only those that did
        low, high = known.codes()
        low = np.minimum(low * parts, minimum.ravel()[some])
        high = np.maximum(high * parts, maximum.ravel()[some])
        levels = [(0.0, 1.0 - weight), *((step, weight * w) for step, w in known.law.free_satellite_pattern)]
        masses = []
        for step, share in levels:
            moved = columns + np.outer(amplitude * step / columns[:, 1], [0.0, 0.0, 1.0, 0.0])
            level = KnownPixels(list(moved.T), known.law, (np.zeros(some.size), np.zeros(some.size)))
            tables = number_tables(low, high, exposure, level, parts=parts, detailed=True)
            pixel = np.repeat(np.arange(some.size), np.diff(tables.start))
            masses.append(share[pixel] * tables.mass)
        total = np.sum(masses, axis=0)
        steps = np.array([step for step, _ in levels])
        mean = amplitude[pixel] * (steps @ masses) / np.where(total > 0.0, total, 1.0)
        # Var(a + n - E[a | x]) with Cov(n, E[a | x]) = sigma^2 E[d E[a | x] / dx], n Gaussian (Stein 1981)
        code_e = columns[pixel, 1] / parts
        slope = np.where(np.diff(pixel, append=-1) == 0, np.diff(mean, append=0.0), 0.0) / code_e
        shares = np.array([share for _, share in levels])
        variance = shares.T @ steps**2 - (shares.T @ steps) ** 2
        read = (columns[:, 1] * nearest_pcd(known.parameters, known.law)[3]) ** 2

        def expected(values: FloatArray) -> FloatArray:
            return np.bincount(pixel, total * values, some.size) / np.bincount(pixel, total, some.size)

        explained = expected(mean**2) - expected(mean) ** 2
        left = read * (1.0 - 2.0 * expected(slope)) + amplitude**2 * variance - explained
        return cls(some, tables, mean.astype(np.float32), np.sqrt(np.maximum(left, 0.0)))

    def subtract(self, electrons: Float32Array, codes: CodeArray, lift: int) -> None:
        """Take the jumps from frames (frame, y, x), e-, whose codes, raised by ``lift``, are given."""
        n = len(electrons)
        own = codes.reshape(n, -1)[:, self.pixels].astype(np.int64) - (self.tables.first + lift)
        place = np.clip(own, 0, np.diff(self.tables.start) - 1) + self.tables.start[:-1]
        electrons.reshape(n, -1)[:, self.pixels] -= self.jump[place]
