"""The fits give the same bits in every process: kernels compiled or loaded, in whatever order.

Each line is a process of its own: with an empty kernel cache or with the one that the last line left, fitting
single exposures first or the joint fit first. Exits with 1 unless all results are equal.

    python scripts/validation/same_bits.py       # about three minutes: every kernel is compiled twice
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile

from pchem_pipeline.compute.environment import prepare_environment

N_PIXELS, N_FRAMES = 64, 1500


def results(order: str) -> str:
    """Fit the same pixels and return a digest by fit, whichever comes first."""
    prepare_environment()
    import numpy as np

    from pchem_pipeline.model.fit.api import fit_histograms

    rng = np.random.default_rng(5)
    step, bias = rng.uniform(8, 14, N_PIXELS), rng.uniform(95, 105, N_PIXELS)
    counts, origins = [], []
    for exposure in (1.0, 4.0, 0.0):
        k = rng.poisson(exposure, (N_PIXELS, N_FRAMES))
        x = np.rint(bias[:, None] + k * step[:, None] + 3.3 * rng.normal(size=k.shape)).astype(int)
        origin = x.min(axis=1)
        histogram = np.zeros((N_PIXELS, int((x.max(axis=1) - origin).max()) + 1), np.uint32)
        np.add.at(histogram, (np.arange(N_PIXELS)[:, None], x - origin[:, None]), 1)
        counts.append(histogram)
        origins.append(origin.astype(np.int32))
    found = {}
    for kind in order.split(","):
        if kind == "joint":
            joint = fit_histograms(counts, origins, dark=[False, False, True])
            arrays = [joint.conversion_gain, joint.covariance]
        else:
            single = fit_histograms(counts[0], origins[0])
            arrays = [single.conversion_gain, single.covariance, single.log_likelihood, single.goodness_chi2]
        found[kind] = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]
    return f"single {found['single']} joint {found['joint']}"


def main() -> None:
    if len(sys.argv) > 1:
        print(results(sys.argv[1]))
        return
    seen = set()
    for first in ("single,joint", "joint,single"):
        with tempfile.TemporaryDirectory() as cache:
            for kernels, order in (
                ("compiled", first),
                ("loaded", first),
                ("loaded", ",".join(reversed(first.split(",")))),
            ):
                line = subprocess.run(
                    [sys.executable, __file__, order],
                    env={**os.environ, "NUMBA_CACHE_DIR": cache},
                    check=True,
                    capture_output=True,
                    text=True,
                ).stdout.strip()
                print(f"{kernels:9s} {order:13s} {line}", flush=True)
                seen.add(line)
    print("same bits" if len(seen) == 1 else "DIFFERENT")
    sys.exit(len(seen) > 1)


if __name__ == "__main__":
    main()
