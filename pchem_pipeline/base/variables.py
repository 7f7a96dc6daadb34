"""Every array that a run stores: name, dimensions, type, unit and sentence.

Nothing is written that is not listed here; the attributes in the store come from here, so that
``xarray.open_zarr(run, group="fit")`` shows dimensions, units and long names.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

#: The four parameters of the PCD, in the order of every (…, parameter) axis.
PARAMETERS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")

#: Names of the quanta exposure over the integration time: in the dark, and where something else made charge.
CHARGE_RATES = ("dark_current", "charge_rate")
#: Maps of what the fit determines, each with a standard error.
MEASURED_MAPS = (*PARAMETERS, "read_noise_e", "analog_read_noise_e", *CHARGE_RATES)

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
        long_name: one sentence.
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


#: Values of pixels that no tile was done for, where they are not 0: a fit that was not made, and no value.
_FILLS = {"fit/fit_status": 16384, "maps/quality": 2}

#: Unit, sentence, symbol and its mathtext of each parameter, in the order of tables; what people call it is
#: the sentence up to a sign.
PARAMETER_WORDS = {
    "quanta_exposure": ("e-", "quanta exposure: mean number of electrons per frame", "H", r"$H$"),
    "charge_rate": ("e-/px/s", "charge rate: quanta exposure / integration time", "H/t", r"$H/t$"),
    "dark_current": (
        "e-/px/s",
        "dark current: quanta exposure / integration time, in the dark",
        "i_d",
        r"$i_\mathrm{d}$",
    ),
    "charge_per_level": (
        "e-/level",
        "charge per light level: slope of the quanta exposure",
        "",
        r"$\mathrm{d}H/\mathrm{d}\ell$",
    ),
    "spurious_charge": ("e-", "spurious charge: exposure at integration time 0", "H_0", r"$H_0$"),
    "dark_signal": ("e-", "dark signal: quanta exposure at light level 0", "H_0", r"$H_0$"),
    "conversion_gain": ("e-/DN", "conversion gain", "g", r"$g$"),
    "bias": ("DN", "bias: DN at zero electrons", "mu", r"$\mu$"),
    "read_noise_dn": ("DN", "read noise, quantisation included", "sigma", r"$\sigma$"),
    "read_noise_e": ("e-", "read noise, quantisation included", "sigma_e-", r"$\sigma_{\mathrm{e}^-}$"),
    "analog_read_noise_e": ("e-", "analog read noise, quantisation removed", "sigma_R", r"$\sigma_R$"),
}


def _table(text: str) -> list[Variable]:
    """Return the arrays of a table: path | dimensions | type | unit | sentence, and maybe | symbol.

    A line that is indented continues the one before; ``#`` begins a remark.
    """
    lines = re.sub(r"\n +", " ", text.strip()).splitlines()
    rows = [line.split(" | ") for line in lines if not line.startswith("#")]
    return [
        Variable(path, tuple(dims.split()), *rest, fill=_FILLS.get(path, 0)) for path, dims, *rest in rows
    ]


def _parameter(group: str, name: str, words: str = "", suffix: str = "") -> Variable:
    """Return a parameter, or, with a suffix, what the words say of it."""
    unit, sentence, symbol, _ = PARAMETER_WORDS[name]
    symbol = "" if suffix else symbol
    return Variable(f"{group}/{name}{suffix}", ("y", "x"), "float64", unit, words + sentence, symbol)


def _both(group: str, names: tuple[str, ...]) -> list[Variable]:
    """Return parameters, each with its standard error."""
    made = ("", ""), ("standard error of the ", "_stderr")
    return [_parameter(group, name, *each) for name in names for each in made]


def _ends(group: str, names: tuple[str, ...]) -> list[Variable]:
    """Return the ends of the profile intervals of parameters."""
    ends = [*zip(("lower", "upper"), interval_names(""), strict=True)]
    return [
        _parameter(group, name, f"{end} end of the profile-likelihood interval of the ", suffix)
        for name in names
        for end, suffix in ends
    ]


_ALL: list[Variable] = [
    *_table("""
frames/dn | frame y x | * | DN | raw frames
frames/excluded | y x | uint8 | 1 | 0 used, 1 excluded (mask, overscan, marker, stamp)
# counts per pixel; DN of bin b is origin + b
histogram/counts | y x bin | * | 1 | number of frames with DN = origin + bin
histogram/origin | y x | int32 | DN | DN of bin 0
histogram/under | y x | uint32 | 1 | number of frames below bin 0
histogram/over | y x | uint32 | 1 | number of frames above the last bin
histogram/minimum | y x | int32 | DN | smallest DN seen
histogram/maximum | y x | int32 | DN | largest DN seen
# what histograms lose: order in time and neighbours in space
summary/block_start | block | int64 | 1 | first frame of the block
summary/block_sum | block y x | int64 | DN | sum over a block of frames
summary/block_sum_square | block y x | int64 | DN2 | sum of squares over a block of frames
summary/lag1_covariance | y x | float64 | DN2 | covariance of successive frames, within blocks; 0 is expected
    of independent frames
summary/neighbour_covariance_x | y x | float64 | DN2 | covariance with the pixel at x + 1, within blocks; NaN
    in the last column
summary/neighbour_covariance_y | y x | float64 | DN2 | covariance with the pixel at y + 1, within blocks; NaN
    in the last row of 64
summary/row_sum | frame y | int64 | DN | sum over a row of a frame
summary/row_sum_square | frame y | int64 | DN2 | sum of squares over a row of a frame
summary/column_sum | frame row_group x | int32 | DN | sum over 64 rows of a column of a frame
summary/open_sums | sum y x | int64 | 1 | sums of the last time block, for appending
summary/open_covariances | lag y x | float64 | DN2 | sums of covariances, for appending
summary/frame_mean | frame | float64 | DN | mean of a frame
summary/frame_variance | frame | float64 | DN2 | variance over the pixels of a frame
"""),
    *_both("overscan", ("bias", "read_noise_dn")),
    *_both("fit", PARAMETERS),
    *_table("""
fit/correlation | y x parameter_pair | float64 | 1 | correlations of the estimates: (H, g), (H, mu), (H,
    sigma), (g, mu), (g, sigma), (mu, sigma)
"""),
    *_ends("fit", INTERVALS),
    *_table("""
fit/log_likelihood | y x | float64 | nat | log-likelihood at the estimate
fit/likelihood_gap | y x | float64 | nat | log-likelihood ratio to the next best fit
fit/fit_status | y x | uint16 | 1 | reasons for caution or failure, as bits; 0: good
fit/n_iterations | y x | int32 | 1 | likelihood evaluations for the pixel
fit/goodness_chi2 | y x | float64 | 1 | Pearson chi-square of the histogram, bins merged
fit/goodness_dof | y x | float64 | 1 | degrees of freedom of goodness_chi2
fit/goodness_p | y x | float64 | 1 | p-value of the chi-square if the model holds
fit/outlier_share | y x | float64 | 1 | share of the frames excluded by the tail guard
# where the model's effects look for levels in each pixel (random telegraph noise)
fit/satellite_amplitude_e | y x | float64 | e- | distance of the pixel's levels; NaN: one level
fit/satellite_weight | y x | float64 | 1 | probability of the other level; 0: one level
"""),
    *_both("maps", MEASURED_MAPS),
    *_ends("maps", (*INTERVALS, *CHARGE_RATES)),
    *_table("""
maps/goodness_q | y x | float64 | 1 | false-discovery rate at which the pixel is a misfit
"""),
    *_both("maps", ("spurious_charge", "charge_per_level", "dark_signal")),  # of several exposures
    *_table("""
# of a fit of several exposures, beside its maps; axis `sample`: the exposures
samples/quanta_exposure | sample y x | float64 | e- | quanta exposure: mean number of electrons per frame | H
samples/quanta_exposure_stderr | sample y x | float64 | e- | standard error of the quanta exposure: mean
    number of electrons per frame
samples/mean | sample y x | float64 | DN | mean of the sample
samples/variance | sample y x | float64 | DN2 | variance of the sample
samples/covariance | y x sample_parameter sample_parameter_2 | float64 | 1 | covariance of (H_1 ... H_J, g,
    mu, sigma)
samples/linearity_residual | sample y x | float64 | e- | quanta exposure minus the fitted line
samples/linearity_residual_stderr | sample y x | float64 | e- | standard error of the residual
samples/linearity_chi2 | y x | float64 | 1 | chi-square of the exposures against the line
samples/linearity_p | y x | float64 | 1 | p-value of the chi-square for a linear pixel
maps/quality | y x | uint8 | 1 | 0 good, 1 use with caution, 2 no value
# raw ensemble (paper, Sec. II-C): axis `dn`; after two-point non-uniformity correction: axis `electrons`;
# electron numbers: axis `k`
ensemble/dn | dn | int32 | DN | digital number
ensemble/counts | dn | int64 | 1 | ensemble histogram of the chosen frames
ensemble/counts_all | dn | int64 | 1 | ensemble histogram of all frames
ensemble/density | dn | float64 | 1/DN | ensemble histogram of the chosen frames, normalised
ensemble/density_all | dn | float64 | 1/DN | ensemble histogram of all frames, normalised
ensemble/epcd_exact | dn | float64 | 1/DN | EPCD: mean of the pixels' PCDs | f_E
ensemble/epcd_stderr | dn | float64 | 1/DN | standard error of epcd_exact from the errors of the maps
ensemble/epcd_dependent | dn | float64 | 1/DN | EPCD: 4-D histogram of the parameters | f_E
ensemble/epcd_independent | dn | float64 | 1/DN | EPCD: product of four histograms | f_E
ensemble/residual | dn | float64 | 1 | (density - epcd_exact) / counting error
ensemble/electrons | electrons | float64 | e- | centre of the bin of NUCed data
ensemble/nuced_counts | electrons | int64 | 1 | ensemble histogram of NUCed frames
ensemble/nuced_density | electrons | float64 | 1/e- | NUCed ensemble histogram, normalised
ensemble/nuced_exact | electrons | float64 | 1/e- | NUCed EPCD: mean over the pixels | f_E'
ensemble/nuced_stderr | electrons | float64 | 1/e- | standard error of nuced_exact from the errors of the maps
ensemble/nuced_dependent | electrons | float64 | 1/e- | NUCed EPCD: 2-D histogram of (H, s_e) | f_E'
ensemble/nuced_independent | electrons | float64 | 1/e- | NUCed EPCD: product of histograms | f_E'
ensemble/nuced_residual | electrons | float64 | 1 | (nuced_density - nuced_exact) / counting error
ensemble/k | k | int32 | e- | electron number | k
ensemble/electron_counts | k | int64 | 1 | histogram of the estimated electron numbers
ensemble/electron_mass | k | float64 | 1 | histogram of electron numbers, normalised
ensemble/electron_pmf | k | float64 | 1 | mass predicted from the map of H | p_Ke
ensemble/electron_pmf_binned | k | float64 | 1 | mass predicted from the histogram of H | p_Ke
ensemble/electron_pmf_map | k | float64 | 1 | expected share of the estimates of k
ensemble/component_mean | component | float64 | DN | mean of the EPCD's component k | E(E|K_e=k)
ensemble/component_variance | case component | float64 | DN2 | variance of the EPCD's component k, parameters
    of the case held constant | Var(E|K_e=k)
ensemble/nuced_component_variance | component | float64 | e-2 | variance of the NUCed EPCD's component k |
    Var(E'|K_e=k)
# what each tile adds to the ensemble; kept so that a run can resume
ensemble_tiles/integers | tile integer | int64 | 1 | tallies of the tile's data
ensemble_tiles/floats | tile float | float64 | 1 | sums over the tile's pixels
electrons/electron_number | frame y x | uint16 | e- | estimated electron number | k
# where the model and the data disagree; axes: `score` as effects.evidence.SCORES, `channel` charge and
# readout, `side` below and above, `pair` x.kk to y.rk, `statistic` as discrepancy.catalogue.STATISTICS
discrepancy/goodness | y x | float32 | 1 | goodness of fit per pixel as normal quantile; large: poor
discrepancy/score | score y x | float32 | 1 | efficient scores per pixel, N(0, 1) expected
discrepancy/block_spread | channel y x | float32 | 1 | scatter of the block means, normal quantile
discrepancy/lag1 | channel y x | float32 | 1 | autocorrelation at lag 1 over its standard error
discrepancy/trend | channel y x | float32 | 1 | trend of the block means, N(0, 1) expected
discrepancy/neighbour | pair y x | float32 | 1 | covariance with the next pixel, N(0, 1) expected
discrepancy/tail | side y x | uint32 | 1 | samples outside the range of the pixel's PCD
discrepancy/code_dn | code | int32 | DN | digital number of the code axis
discrepancy/code_observed | code | float64 | 1 | samples at each DN, all usable pixels
discrepancy/code_expected | code | float64 | 1 | samples expected at each DN from the fitted PCDs
discrepancy/code_extended | code | float64 | 1 | samples expected at each DN with effects
discrepancy/added_exposure | added_level y x | float64 | e- | exposure that effects add to pixels
discrepancy/added_weight | added_level y x | float64 | 1 | share of frames at each added exposure
discrepancy/frame_number | frame | int64 | 1 | frame number in the run
discrepancy/frame_charge | frame | float64 | 1 | relative deviation of the exposure of each frame
discrepancy/frame_readout | frame | float64 | DN | mean readout residual of each frame
discrepancy/frame_noise | frame | float64 | 1 | squares of the residuals of each frame, N(0, 1)
discrepancy/frame_sd | channel | float64 | 1 | sampling noise of frame_charge and frame_readout (DN)
discrepancy/frame_charge_model | frame | float64 | 1 | path of frame_charge under the named effects
discrepancy/frame_readout_model | frame | float64 | DN | path of frame_readout under the named effects
discrepancy/z_before | statistic | float64 | 1 | statistics against the plain model
discrepancy/z_after | statistic | float64 | 1 | statistics against the model with effects
discrepancy/row_rms | channel y | float64 | 1 | rms over the frames of the means of the rows over their
    sampling noise
discrepancy/row_image | channel shown_frame y | float32 | 1 | first frames: means of the rows over their
    sampling noise
discrepancy/column_rms | channel x | float64 | 1 | rms over the frames of the means of the columns over their
    sampling noise
discrepancy/column_image | channel shown_frame x | float32 | 1 | first frames: means of the columns over their
    sampling noise
# of each version of the run's model, in a group of its own: model/0002/added_exposure
model/added_exposure | added_level y x | float64 | e- | exposure that effects add to pixels
model/added_weight | added_level y x | float64 | 1 | share of frames at each added exposure
# what `pchem apply` makes of other frames of the sensor
applied/frame | frame | int64 | 1 | number of the frame, over all files
applied/y | y | int64 | pixel | row of the run
applied/x | x | int64 | pixel | column of the run
applied/electrons | frame y x | float32 | e- | signal after two-point correction, g (x - mu)
applied/electrons_stderr_read | y x | float32 | e- | 1 sigma error per sample from read noise
applied/electrons_stderr_calibration | y x | float32 | e- | 1 sigma error from the calibration at the mean
    signal, common to all frames
applied/calibration_variance | power y x | float64 | e-2 | c_0, c_1, c_2 of the variance c_0 + c_1 E + c_2 E^2
    from the calibration at a signal of E e-
applied/mean_signal | y x | float64 | e- | mean signal of the frames
applied/at_adc_limit | frame y x | uint8 | 1 | 1 for samples at a limit of the ADC
applied/electron_number | frame y x | * | e- | most probable electron number
applied/number_probability | frame y x | float32 | 1 | probability that the electron number is right
applied/expected_number | frame y x | float32 | e- | mean of the electron number given the sample
applied/exposure | y x | float64 | e- | quanta exposure of these frames, by maximum likelihood
applied/exposure_stderr | y x | float64 | e- | standard error of the exposure: samples and calibration
applied/exposure_stderr_counting | y x | float64 | e- | part of the error from the samples
applied/exposure_stderr_calibration | y x | float64 | e- | part of the error from the calibration
applied/quality | y x | uint32 | 1 | why a pixel has no value or needs caution; 0: good
applied/row_offset | frame part y | float32 | DN | subtracted row offset
applied/column_offset | frame part x | float32 | DN | subtracted column offset
applied/wave_offset | frame wave coefficient | float32 | DN | c and s of the subtracted pattern c cos(2 pi
    (f_y y + f_x x)) + s sin(...)
applied/readout_offset | frame y x | float32 | DN | subtracted 1/f noise along the readout
applied/offset_part | part y x | bool | 1 | pixels of the part with common offsets
applied/noise_before | y x | float64 | e- | standard deviation over the frames, with the offsets
applied/noise_after | y x | float64 | e- | standard deviation over the frames, without the offsets
# what is done so far, while it is being made
applied_parts/jump_noise | y x | float64 | e- | of pixels with a trap, noise without telegraph jumps
applied_parts/sums | segment sum y x | float64 | 1 | sums over a segment of the frames
applied_parts/range | end y x | int64 | 1 | smallest and largest code
applied_parts/prior | y x | float64 | e- | exposure from the mean of these frames, used for the prior
applied_parts/covariance | y x row column | float64 | 1 | of (g, mu, sigma), from their likelihood
applied_parts/rivals | y x side quantity | float64 | 1 | probability that the bias is an electron lower or
    higher, and g, mu, sigma in this case
# other methods beside PCH-EM; the attribute `methods` of the estimates names the axis `method`
methods/pixel_y | pixel | int32 | 1 | row of the compared pixel
methods/pixel_x | pixel | int32 | 1 | column of the compared pixel
"""),
    *[
        replace(_parameter("methods", name, "by each method: "), dims=("method", "pixel"))
        for name in PARAMETERS
    ],
    *[_parameter("truth", name, "true ") for name in (*PARAMETERS, "read_noise_e", "analog_read_noise_e")],
    *_table("""
truth/defect | y x | uint8 | 1 | kind of pixel: 0 normal, 1 hot, 2 dead, 3 stuck
truth/electron_number | frame y x | uint32 | e- | true electron number | K
"""),
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
