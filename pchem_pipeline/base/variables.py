"""Every array that a run stores: name, dimensions, type, unit and sentence.

Nothing is written that is not listed here; the attributes in the store come from here, so that
``xarray.open_zarr(run, group="fit")`` shows dimensions, units and long names.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

#: The four parameters of the PCD, in the order of every (…, parameter) axis.
PARAMETERS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")

#: Names of the quanta exposure over the integration time: in the dark, and where something else made charge.
CHARGE_RATES = ("dark_current", "charge_rate")

#: Arrays of the group ``fit`` that exist only where the model holds effects.
FREE_SATELLITES = ("satellite_amplitude_e", "satellite_weight")

#: Quantities of the group ``fit`` that have profile intervals, where they were asked for.
INTERVALS = (*PARAMETERS, "read_noise_e")

#: Lengths of the dimensions of maps beside y and x.
LENGTHS = {"parameter_pair": 6}


def interval_names(name: str) -> tuple[str, str]:
    """Return the names of the arrays that hold the lower and the upper end of a quantity's interval."""
    return f"{name}_low", f"{name}_high"


@dataclass(frozen=True)
class Variable:
    """One stored array.

    Attributes:
        path: ``group/name`` in the store.
        dims: names of the dimensions, slowest first.
        dtype: numpy type, or ``"*"`` where the data decide (for example the frames).
        unit: physical unit; ``"1"`` where there is none.
        long_name: one sentence for people.
        symbol: the symbol of the paper, if it has one.
        fill: value of pixels that no tile was done for; of floating-point arrays it is NaN.
    """

    path: str
    dims: tuple[str, ...]
    dtype: str
    unit: str
    long_name: str
    symbol: str = ""
    fill: int = field(default=0, kw_only=True)

    @property
    def group(self) -> str:
        """Name of the group that holds the array."""
        return self.path.split("/", 1)[0]

    @property
    def name(self) -> str:
        """Name of the array inside its group."""
        return self.path.split("/", 1)[1]

    def index(self, region: tuple[slice, slice]) -> tuple[slice, ...]:
        """Return the index of a region (y, x) of the sensor in the array, whole along other dimensions."""
        return (*(slice(None),) * self.dims.index("y"), *region)


_MAP = ("y", "x")

_PARAMETER_WORDS = {
    "quanta_exposure": ("e-", "quanta exposure: mean number of electrons per frame", "H"),
    "conversion_gain": ("e-/DN", "conversion gain", "g"),
    "bias": ("DN", "bias: DN at zero electrons", "mu"),
    "read_noise_dn": ("DN", "read noise, quantisation included", "sigma"),
    "read_noise_e": ("e-", "read noise, quantisation included", "sigma_e-"),
    "analog_read_noise_e": ("e-", "analog read noise, quantisation removed", "sigma_R"),
    "charge_rate": ("e-/px/s", "charge rate: quanta exposure / integration time", "H/t"),
    "dark_current": ("e-/px/s", "dark current: quanta exposure / integration time, in the dark", "i_d"),
    "spurious_charge": ("e-", "spurious charge: exposure at integration time 0", "H_0"),
    "dark_signal": ("e-", "dark signal: quanta exposure at light level 0", "H_0"),
    "charge_per_level": ("e-/level", "slope of the quanta exposure against the light level", ""),
}


def _parameter(group: str, name: str, words: str = "") -> Variable:
    unit, sentence, symbol = _PARAMETER_WORDS[name]
    return Variable(f"{group}/{name}", _MAP, "float64", unit, words + sentence, symbol)


def _stderr(group: str, name: str) -> Variable:
    unit, sentence, _ = _PARAMETER_WORDS[name]
    return Variable(f"{group}/{name}_stderr", _MAP, "float64", unit, f"standard error of the {sentence}")


def _both(group: str, names: tuple[str, ...]) -> list[Variable]:
    return [make(group, name) for name in names for make in (_parameter, _stderr)]


def _ends(group: str, names: tuple[str, ...]) -> list[Variable]:
    found = []
    for name in names:
        unit, sentence, _ = _PARAMETER_WORDS[name]
        for end, path in zip(("lower", "upper"), interval_names(name), strict=True):
            words = f"{end} end of the profile-likelihood interval of the {sentence}"
            found.append(Variable(f"{group}/{path}", _MAP, "float64", unit, words))
    return found


def _samples() -> list[Variable]:
    """Return what a fit of several exposures keeps beside its maps; axis ``sample``: the exposures."""
    unit, sentence, symbol = _PARAMETER_WORDS["quanta_exposure"]
    cube = ("sample", *_MAP)
    both = ("sample_parameter", "sample_parameter_2")
    found: list[tuple[str, tuple[str, ...], str, str, str]] = [
        ("quanta_exposure", cube, unit, sentence, symbol),
        ("quanta_exposure_stderr", cube, unit, f"standard error of the {sentence}", ""),
        ("mean", cube, "DN", "mean of the sample", ""),
        ("variance", cube, "DN2", "variance of the sample", ""),
        ("covariance", (*_MAP, *both), "1", "covariance of (H_1 ... H_J, g, mu, sigma)", ""),
        ("linearity_residual", cube, "e-", "quanta exposure minus the fitted line", ""),
        ("linearity_residual_stderr", cube, "e-", "standard error of the residual", ""),
        ("linearity_chi2", _MAP, "1", "chi-square of the exposures against the line", ""),
        ("linearity_p", _MAP, "1", "p-value of the chi-square for a linear pixel", ""),
    ]
    return [Variable(f"samples/{name}", dims, "float64", *rest) for name, dims, *rest in found]


def _discrepancy() -> list[Variable]:
    """Return what the figures of the discrepancy verdict are drawn from."""
    rows = {"row": "y", "column": "x"}
    found: list[tuple[str, tuple[str, ...], str, str, str]] = [
        ("goodness", _MAP, "float32", "1", "goodness of fit per pixel as normal quantile; large: poor"),
        ("score", ("score", *_MAP), "float32", "1", "efficient scores per pixel, N(0, 1) expected"),
        ("block_spread", ("channel", *_MAP), "float32", "1", "scatter of the block means, normal quantile"),
        ("lag1", ("channel", *_MAP), "float32", "1", "autocorrelation at lag 1 over its standard error"),
        ("trend", ("channel", *_MAP), "float32", "1", "trend of the block means, N(0, 1) expected"),
        ("neighbour", ("pair", *_MAP), "float32", "1", "covariance with the next pixel, N(0, 1) expected"),
        ("tail", ("side", *_MAP), "uint32", "1", "samples outside the range of the pixel's PCD"),
        ("code_dn", ("code",), "int32", "DN", "digital number of the code axis"),
        ("code_observed", ("code",), "float64", "1", "samples at each DN, all usable pixels"),
        ("code_expected", ("code",), "float64", "1", "samples expected at each DN from the fitted PCDs"),
        ("code_extended", ("code",), "float64", "1", "samples expected at each DN with effects"),
        ("added_exposure", ("added_level", *_MAP), "float64", "e-", "exposure that effects add to pixels"),
        ("added_weight", ("added_level", *_MAP), "float64", "1", "share of frames at each added exposure"),
        ("frame_number", ("frame",), "int64", "1", "frame number in the run"),
        ("frame_charge", ("frame",), "float64", "1", "relative deviation of the exposure of each frame"),
        ("frame_readout", ("frame",), "float64", "DN", "mean readout residual of each frame"),
        ("frame_noise", ("frame",), "float64", "1", "squares of the residuals of each frame, N(0, 1)"),
        ("frame_sd", ("channel",), "float64", "1", "sampling noise of frame_charge and frame_readout (DN)"),
        ("frame_charge_model", ("frame",), "float64", "1", "path of frame_charge under the named effects"),
        ("frame_readout_model", ("frame",), "float64", "DN", "path of frame_readout under the named effects"),
        ("z_before", ("statistic",), "float64", "1", "statistics against the plain model"),
        ("z_after", ("statistic",), "float64", "1", "statistics against the model with effects"),
    ]  # fmt: skip
    for line, axis in rows.items():
        words = f"means of the {line}s over their sampling noise"
        found += [
            (f"{line}_rms", ("channel", axis), "float64", "1", f"rms over the frames of the {words}"),
            (f"{line}_image", ("channel", "shown_frame", axis), "float32", "1", f"first frames: {words}"),
        ]
    return [
        Variable(f"discrepancy/{name}", dims, dtype, unit, words) for name, dims, dtype, unit, words in found
    ]


def _applied() -> list[Variable]:
    """Return what `pchem apply` makes of other frames of the sensor."""
    cube = ("frame", *_MAP)
    found: list[tuple[str, tuple[str, ...], str, str, str]] = [
        ("frame", ("frame",), "int64", "1", "number of the frame, over all files"),
        ("y", ("y",), "int64", "pixel", "row of the run"),
        ("x", ("x",), "int64", "pixel", "column of the run"),
        ("electrons", cube, "float32", "e-", "signal after two-point correction, g (x - mu)"),
        ("electrons_stderr_read", _MAP, "float32", "e-", "1 sigma error per sample from read noise"),
        (
            "electrons_stderr_calibration",
            _MAP,
            "float32",
            "e-",
            "1 sigma error from the calibration at the mean signal, common to all frames",
        ),
        (
            "calibration_variance",
            ("power", *_MAP),
            "float64",
            "e-2",
            "c_0, c_1, c_2 of the variance c_0 + c_1 E + c_2 E^2 from the calibration at a signal of E e-",
        ),
        ("mean_signal", _MAP, "float64", "e-", "mean signal of the frames"),
        ("electron_number", cube, "*", "e-", "most probable electron number"),
        ("number_probability", cube, "float32", "1", "probability that the electron number is right"),
        ("expected_number", cube, "float32", "e-", "mean of the electron number given the sample"),
        ("exposure", _MAP, "float64", "e-", "quanta exposure of these frames, by maximum likelihood"),
        ("exposure_stderr", _MAP, "float64", "e-", "standard error of the exposure: samples and calibration"),
        ("exposure_stderr_counting", _MAP, "float64", "e-", "part of the error from the samples"),
        ("exposure_stderr_calibration", _MAP, "float64", "e-", "part of the error from the calibration"),
        ("quality", _MAP, "uint32", "1", "why a pixel has no value or needs caution; 0: good"),
        ("row_offset", ("frame", "part", "y"), "float32", "DN", "subtracted row offset"),
        ("column_offset", ("frame", "part", "x"), "float32", "DN", "subtracted column offset"),
        (
            "wave_offset",
            ("frame", "wave", "coefficient"),
            "float32",
            "DN",
            "c and s of the subtracted pattern c cos(2 pi (f_y y + f_x x)) + s sin(...)",
        ),
        ("offset_part", ("part", *_MAP), "bool", "1", "pixels of the part with common offsets"),
        ("noise_before", _MAP, "float64", "e-", "standard deviation over the frames, with the offsets"),
        ("noise_after", _MAP, "float64", "e-", "standard deviation over the frames, without the offsets"),
    ]
    # what is done so far, while it is being made
    parts: list[tuple[str, tuple[str, ...], str, str, str]] = [
        ("sums", ("segment", "sum", *_MAP), "float64", "1", "sums over a segment of the frames"),
        ("range", ("end", *_MAP), "int64", "1", "smallest and largest code"),
        ("prior", _MAP, "float64", "e-", "exposure from the mean of these frames, used for the prior"),
        ("covariance", (*_MAP, "row", "column"), "float64", "1", "of (g, mu, sigma), from their likelihood"),
        (
            "rivals",
            (*_MAP, "side", "quantity"),
            "float64",
            "1",
            "probability that the bias is an electron lower or higher, and g, mu, sigma in this case",
        ),
    ]
    return [
        Variable(f"{group}/{name}", dims, dtype, unit, words)
        for group, variables in (("applied", found), ("applied_parts", parts))
        for name, dims, dtype, unit, words in variables
    ]


_ALL: list[Variable] = [
    Variable("frames/dn", ("frame", "y", "x"), "*", "DN", "raw frames"),
    Variable("frames/excluded", _MAP, "uint8", "1", "0 used, 1 excluded by the mask or its marker"),
    # counts per pixel; DN of bin b is origin + b
    Variable("histogram/counts", ("y", "x", "bin"), "*", "1", "number of frames with DN = origin + bin"),
    Variable("histogram/origin", _MAP, "int32", "DN", "DN of bin 0"),
    Variable("histogram/under", _MAP, "uint32", "1", "number of frames below bin 0"),
    Variable("histogram/over", _MAP, "uint32", "1", "number of frames above the last bin"),
    Variable("histogram/minimum", _MAP, "int32", "DN", "smallest DN seen"),
    Variable("histogram/maximum", _MAP, "int32", "DN", "largest DN seen"),
    # what histograms lose: order in time and neighbours in space
    Variable("summary/block_start", ("block",), "int64", "1", "first frame of the block"),
    Variable("summary/block_sum", ("block", "y", "x"), "int64", "DN", "sum over a block of frames"),
    Variable(
        "summary/block_sum_square",
        ("block", "y", "x"),
        "int64",
        "DN2",
        "sum of squares over a block of frames",
    ),
    Variable(
        "summary/lag1_covariance",
        _MAP,
        "float64",
        "DN2",
        "covariance of successive frames, within blocks; 0 is expected of independent frames",
    ),
    Variable(
        "summary/neighbour_covariance_x",
        _MAP,
        "float64",
        "DN2",
        "covariance with the pixel at x + 1, within blocks; NaN in the last column",
    ),
    Variable(
        "summary/neighbour_covariance_y",
        _MAP,
        "float64",
        "DN2",
        "covariance with the pixel at y + 1, within blocks; NaN in the last row of 64",
    ),
    Variable("summary/row_sum", ("frame", "y"), "int64", "DN", "sum over a row of a frame"),
    Variable(
        "summary/row_sum_square", ("frame", "y"), "int64", "DN2", "sum of squares over a row of a frame"
    ),
    Variable(
        "summary/column_sum",
        ("frame", "row_group", "x"),
        "int32",
        "DN",
        "sum over 64 rows of a column of a frame",
    ),
    Variable(
        "summary/open_sums", ("sum", "y", "x"), "int64", "1", "sums of the last time block, for appending"
    ),
    Variable(
        "summary/open_covariances", ("lag", "y", "x"), "float64", "DN2", "sums of covariances, for appending"
    ),
    Variable("summary/frame_mean", ("frame",), "float64", "DN", "mean of a frame"),
    Variable("summary/frame_variance", ("frame",), "float64", "DN2", "variance over the pixels of a frame"),
    *_both("fit", PARAMETERS),
    Variable(
        "fit/correlation",
        ("y", "x", "parameter_pair"),
        "float64",
        "1",
        "correlations of the estimates: (H, g), (H, mu), (H, sigma), (g, mu), (g, sigma), (mu, sigma)",
    ),
    *_ends("fit", INTERVALS),
    Variable("fit/log_likelihood", _MAP, "float64", "nat", "log-likelihood at the estimate"),
    Variable("fit/likelihood_gap", _MAP, "float64", "nat", "log-likelihood ratio to the next best fit"),
    Variable(
        "fit/fit_status",
        _MAP,
        "uint16",
        "1",
        "reasons for caution or failure, as bits; 0: good",
        fill=16384,
    ),
    Variable("fit/n_iterations", _MAP, "int32", "1", "likelihood evaluations for the pixel"),
    Variable("fit/goodness_chi2", _MAP, "float64", "1", "Pearson chi-square of the histogram, bins merged"),
    Variable("fit/goodness_dof", _MAP, "float64", "1", "degrees of freedom of goodness_chi2"),
    Variable("fit/goodness_p", _MAP, "float64", "1", "p-value of the chi-square if the model holds"),
    Variable("fit/outlier_share", _MAP, "float64", "1", "share of the frames excluded by the tail guard"),
    # where the model's effects look for levels in each pixel (random telegraph noise)
    Variable(
        "fit/satellite_amplitude_e", _MAP, "float64", "e-", "distance of the pixel's levels; NaN: one level"
    ),
    Variable("fit/satellite_weight", _MAP, "float64", "1", "probability of the other level; 0: one level"),
    *_both("maps", (*PARAMETERS, "read_noise_e", "analog_read_noise_e", *CHARGE_RATES)),
    *_ends("maps", (*INTERVALS, *CHARGE_RATES)),
    Variable("maps/goodness_q", _MAP, "float64", "1", "false-discovery rate at which the pixel is a misfit"),
    *_both("maps", ("spurious_charge", "charge_per_level", "dark_signal")),  # of several exposures
    *_samples(),
    Variable("maps/quality", _MAP, "uint8", "1", "0 good, 1 use with caution, 2 no value", fill=2),
    # raw ensemble (paper, Sec. II-C): axis `dn`
    Variable("ensemble/dn", ("dn",), "int32", "DN", "digital number"),
    Variable("ensemble/counts", ("dn",), "int64", "1", "ensemble histogram of the chosen frames"),
    Variable("ensemble/counts_all", ("dn",), "int64", "1", "ensemble histogram of all frames"),
    Variable(
        "ensemble/density", ("dn",), "float64", "1/DN", "ensemble histogram of the chosen frames, normalised"
    ),
    Variable(
        "ensemble/density_all", ("dn",), "float64", "1/DN", "ensemble histogram of all frames, normalised"
    ),
    Variable("ensemble/epcd_exact", ("dn",), "float64", "1/DN", "EPCD: mean of the pixels' PCDs", "f_E"),
    Variable(
        "ensemble/epcd_stderr",
        ("dn",),
        "float64",
        "1/DN",
        "standard error of epcd_exact from the errors of the maps",
    ),
    Variable(
        "ensemble/epcd_dependent", ("dn",), "float64", "1/DN", "EPCD: 4-D histogram of the parameters", "f_E"
    ),
    Variable(
        "ensemble/epcd_independent", ("dn",), "float64", "1/DN", "EPCD: product of four histograms", "f_E"
    ),
    Variable("ensemble/residual", ("dn",), "float64", "1", "(density - epcd_exact) / counting error"),
    # after two-point non-uniformity correction: axis `electrons`
    Variable("ensemble/electrons", ("electrons",), "float64", "e-", "centre of the bin of NUCed data"),
    Variable("ensemble/nuced_counts", ("electrons",), "int64", "1", "ensemble histogram of NUCed frames"),
    Variable(
        "ensemble/nuced_density", ("electrons",), "float64", "1/e-", "NUCed ensemble histogram, normalised"
    ),
    Variable(
        "ensemble/nuced_exact", ("electrons",), "float64", "1/e-", "NUCed EPCD: mean over the pixels", "f_E'"
    ),
    Variable(
        "ensemble/nuced_stderr",
        ("electrons",),
        "float64",
        "1/e-",
        "standard error of nuced_exact from the errors of the maps",
    ),
    Variable(
        "ensemble/nuced_dependent",
        ("electrons",),
        "float64",
        "1/e-",
        "NUCed EPCD: 2-D histogram of (H, s_e)",
        "f_E'",
    ),
    Variable(
        "ensemble/nuced_independent",
        ("electrons",),
        "float64",
        "1/e-",
        "NUCed EPCD: product of histograms",
        "f_E'",
    ),
    Variable(
        "ensemble/nuced_residual",
        ("electrons",),
        "float64",
        "1",
        "(nuced_density - nuced_exact) / counting error",
    ),
    # electron numbers: axis `k`
    Variable("ensemble/k", ("k",), "int32", "e-", "electron number", "k"),
    Variable("ensemble/electron_counts", ("k",), "int64", "1", "histogram of the estimated electron numbers"),
    Variable("ensemble/electron_mass", ("k",), "float64", "1", "histogram of electron numbers, normalised"),
    Variable("ensemble/electron_pmf", ("k",), "float64", "1", "mass predicted from the map of H", "p_Ke"),
    Variable(
        "ensemble/electron_pmf_binned",
        ("k",),
        "float64",
        "1",
        "mass predicted from the histogram of H",
        "p_Ke",
    ),
    Variable("ensemble/electron_pmf_map", ("k",), "float64", "1", "expected share of the estimates of k"),
    Variable(
        "ensemble/component_mean",
        ("component",),
        "float64",
        "DN",
        "mean of the EPCD's component k",
        "E(E|K_e=k)",
    ),
    Variable(
        "ensemble/component_variance",
        ("case", "component"),
        "float64",
        "DN2",
        "variance of the EPCD's component k, parameters of the case held constant",
        "Var(E|K_e=k)",
    ),
    Variable(
        "ensemble/nuced_component_variance",
        ("component",),
        "float64",
        "e-2",
        "variance of the NUCed EPCD's component k",
        "Var(E'|K_e=k)",
    ),
    # what each tile adds to the ensemble; kept so that a run can resume
    Variable("ensemble_tiles/integers", ("tile", "integer"), "int64", "1", "tallies of the tile's data"),
    Variable("ensemble_tiles/floats", ("tile", "float"), "float64", "1", "sums over the tile's pixels"),
    Variable(
        "electrons/electron_number", ("frame", "y", "x"), "uint16", "e-", "estimated electron number", "k"
    ),
    # where the model and the data disagree; axes: `score` as effects.evidence.SCORES, `channel` charge and
    # readout, `side` below and above, `pair` x.kk to y.rk, `statistic` as discrepancy.catalogue.STATISTICS
    *_discrepancy(),
    # of each version of the run's model, in a group of its own: model/0002/added_exposure
    Variable(
        "model/added_exposure", ("added_level", *_MAP), "float64", "e-", "exposure that effects add to pixels"
    ),
    Variable(
        "model/added_weight",
        ("added_level", *_MAP),
        "float64",
        "1",
        "share of frames at each added exposure",
    ),
    # other methods beside PCH-EM; the attribute `methods` of the estimates names the axis `method`
    *_applied(),
    Variable("methods/pixel_y", ("pixel",), "int32", "1", "row of the compared pixel"),
    Variable("methods/pixel_x", ("pixel",), "int32", "1", "column of the compared pixel"),
    *[
        replace(_parameter("methods", name, "by each method: "), dims=("method", "pixel"))
        for name in PARAMETERS
    ],
    *[_parameter("truth", name, "true ") for name in (*PARAMETERS, "read_noise_e", "analog_read_noise_e")],
    Variable("truth/defect", _MAP, "uint8", "1", "kind of pixel: 0 normal, 1 hot, 2 dead, 3 stuck"),
    Variable("truth/electron_number", ("frame", "y", "x"), "uint32", "e-", "true electron number", "K"),
]

VARIABLES: dict[str, Variable] = {variable.path: variable for variable in _ALL}


def variable_at(path: str) -> Variable:
    """Return the variable of an array's path; numbers in it, of versions, are no part of the name.

    Raises:
        KeyError: nothing like it is registered.
    """
    return VARIABLES["/".join(part for part in path.split("/") if not part.isdigit())]


def variables_of(group: str) -> list[Variable]:
    """Return the variables of a group, in the order of the registry."""
    return [variable for variable in _ALL if variable.group == group]
