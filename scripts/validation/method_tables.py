"""The methods of the literature beside PCH-EM on simulated pixels, and plans checked by the real fit.

Prints, for each exposure, the root mean square error of the gain by every method over the read noise with the
bounds, and then how well the frames that ``pchem plan`` asks for do. A CPU minute or two, after the
kernels are compiled.

    python scripts/validation/method_tables.py                   # H = 0.5, 2 and 6 e-, 4000 frames
    python scripts/validation/method_tables.py --exposure 2 --frames 17750 --pixels 400
"""

from __future__ import annotations

import argparse
import math

from pchem_pipeline.compute.environment import prepare_environment

READ_NOISES = (0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.8, 1.0)


def method_table(exposure: float, options: argparse.Namespace) -> None:
    """Print errors, biases, failures and times at one exposure."""
    from pchem_pipeline.methods.compare import StudyPoint, study_point
    from pchem_pipeline.methods.settings import MethodsSettings
    from pchem_pipeline.report.figures.methods import crossing_text

    points = [
        study_point(
            StudyPoint(noise, exposure, options.gain, options.frames, options.pixels, options.seed),
            MethodsSettings(),
        )
        for noise in READ_NOISES
    ]
    print(f"\nH = {exposure:g} e-, {options.frames:,} frames for every method, {options.pixels} pixels")
    head = f"{'read noise, e-':<34}" + "".join(f"{noise:>10g}" for noise in READ_NOISES)
    gain = {
        name: [p["methods"][name]["errors"]["conversion_gain"] for p in points]
        for name in points[0]["methods"]
    }
    for quantity in ("rmse", "bias"):
        print(f"\n{quantity} of g, %\n{head}")
        for name, rows in gain.items():
            print(f"{name:<34}" + "".join(f"{percent(row[quantity]):>10}" for row in rows))
        if quantity == "rmse":
            for bound in points[0]["bounds"]:
                values = [p["bounds"][bound] for p in points]
                print(f"{'limit, ' + bound:<34}" + "".join(f"{percent(value):>10}" for value in values))
    print(f"\npixels without an answer, %\n{head}")
    for name in gain:
        counts = [p["methods"][name] for p in points]
        missing = [100 * (1 - m["n_answered"] / m["n_pixels"]) for m in counts]
        print(f"{name:<34}" + "".join(f"{share:>10.3g}" for share in missing))
    print(f"\nus per pixel\n{head}")
    for name in gain:
        times = [p["methods"][name]["seconds_per_pixel"] for p in points]
        print(f"{name:<34}" + "".join(f"{1e6 * t:>10.0f}" for t in times))
    print(f"\n{crossing_text(points)}")


def percent(value: float | None) -> str:
    """Return a number of per cent, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{100 * value:.3g}"


def plan_table(options: argparse.Namespace) -> None:
    """Print how the real fit does with the frames that a plan asks for."""
    from pchem_pipeline.base.errors import ConfigError
    from pchem_pipeline.planning.plan import plan_one_sample, plan_samples
    from pchem_pipeline.planning.targets import Point, parse_target
    from pchem_pipeline.planning.verify import verify

    target = parse_target("conversion_gain=1%")
    limits = {"budget": None, "max_exposure": 10.0, "max_frames": 1e8}
    print(f"\nplans for {target}, {options.pixels} pixels fitted")
    print(f"{'read noise, e-':>16}{'exposures, e-':>18}{'frames':>12}{'rms error, %':>22}")
    one = [(noise, (exposure,)) for noise in (0.2, 0.3, 0.4, 0.5) for exposure in (0.5, 2.0, 8.0)]
    for noise, exposures in (*one, *((noise, (0.0, 8.0)) for noise in (0.3, 0.6, 1.0))):
        point = Point(exposures[0] or 1.0, noise, options.gain)
        name = " and ".join(f"{exposure:g}" for exposure in exposures)
        try:
            if len(exposures) == 1:
                frames = [int(plan_one_sample([target], point, exposure_given=True, **limits).frames)]
            else:
                frames = list(plan_samples([target], exposures, point, **limits).per_sample)
        except ConfigError:
            print(f"{noise:>16g}{name:>18}  out of reach")
            continue
        found = verify([target], point, exposures, frames, options.pixels, options.seed)
        error = f"{100 * found.checks[0].rmse:.3f} +- {100 * found.checks[0].rmse_stderr:.3f}"
        print(f"{noise:>16g}{name:>18}{sum(frames):>12,}{error:>22}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--exposure", type=float, nargs="*", default=[0.5, 2.0, 6.0], help="H, e-")
    parser.add_argument("--frames", type=int, default=4000, help="frames of a pixel, all samples together")
    parser.add_argument("--pixels", type=int, default=200, help="simulated pixels")
    parser.add_argument("--gain", type=float, default=1 / 11, help="conversion gain, e-/DN")
    parser.add_argument("--seed", type=int, default=2, help="plans simulate with 1")
    parser.add_argument("--no-plans", action="store_true", help="tables of the methods only")
    options = parser.parse_args()
    prepare_environment()
    for exposure in options.exposure:
        method_table(exposure, options)
    if not options.no_plans:
        plan_table(options)


if __name__ == "__main__":
    main()
