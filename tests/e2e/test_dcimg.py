"""A recording of Hamamatsu's cameras comes to the results of the same frames as TIFF."""

import numpy as np
import tifffile
from helpers.commands import assert_same_results
from helpers.dcimg_files import write_dcimg


def test_dcimg_and_tiff_come_to_the_same(shell):
    rng = np.random.default_rng(1)
    electrons = rng.poisson(2.0, (500, 9, 10)) + 0.3 * rng.standard_normal((500, 9, 10))
    stack = np.rint(100 + 8 * electrons).astype(np.uint16)
    write_dcimg(shell.folder / "old.dcimg", stack, version=7, row=4)
    write_dcimg(shell.folder / "new.dcimg", stack, row=4)
    tifffile.imwrite(shell.folder / "plain.tif", stack, photometric="minisblack")
    for name in ("plain.tif", "old.dcimg", "new.dcimg"):
        store = shell.folder / f"{name}.zarr"
        result = shell.ok("run", name, "--integration-time", "1", "--store", store.name, "--until", "maps")
        assert f"ingest: 1 file read as {'tiff' if name == 'plain.tif' else 'dcimg'}" in result.stderr
        assert_same_results(
            store, shell.folder / "plain.tif.zarr", groups=("frames", "histogram", "fit", "maps")
        )
