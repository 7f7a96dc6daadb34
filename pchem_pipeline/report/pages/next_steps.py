"""What to type next: the commands that a run's remarks ask for, the most urgent first."""

from __future__ import annotations

from dataclasses import dataclass

from pchem_pipeline.report.data import ReportData

#: Stands for the run in a command.
RUN = "RUN"
#: Frames that a search for what the model is missing needs.
_SEARCHED = 600


@dataclass(frozen=True)
class Step:
    """A command, with :data:`RUN` in place of the run, and what it is for."""

    command: str
    why: str

    def of(self, run: str) -> str:
        """Return the command as it is typed for a run."""
        return " ".join(run if word == RUN else word for word in self.command.split(" "))


def next_steps(data: ReportData) -> list[Step]:
    """Return what to do next; the first is the one to begin with."""
    if any(stage.get("state") not in (None, "complete") for stage in data.stages) or data.unfitted.any():
        return [Step(f"pchem run {RUN}", "finish the run")]
    step, status = data.code_step, data.fit.get("fit_status")
    if step > 1 and not step & (step - 1):
        why = (
            f"set input.bit_shift: {step.bit_length() - 1} in the YAML (left-justified samples) and run again"
        )
        return [Step(f"pchem run {RUN}", why)]
    if status is not None and ((status & data.failed_mask) != 0).all():
        return [
            Step(
                f"pchem joint EXPOSED.yaml --bias {RUN} --store joint.zarr",
                "if these are bias frames: fit them together with exposed frames",
            ),
            Step(f"pchem view {RUN}", "view the histograms"),
        ]
    if data.quick_look is not None and any(check.name == "levels" for check in data.quick_look.found):
        return [
            Step(
                "pchem run FILES_OF_ONE --store one.zarr",
                "the frames have several exposures: make one run per exposure, then fit them together "
                "(pchem joint)",
            )
        ]
    found = []
    if data.often_flagged and data.samples is None:
        found += [
            Step(
                f"pchem joint {RUN} BRIGHTER.yaml --bias BIAS.yaml --store joint.zarr",
                "fit several exposures together: a second exposure, or bias frames, fix the electron number",
            ),
            Step(
                f"pchem plan --read-noise {_read_noise(data)} --samples 0,2,8 --target conversion_gain=1%",
                "compute how many frames at which exposures are needed, at the read noise that you expect",
            ),
        ]
    if data.mostly_coarse:
        found.append(Step(f"pchem run {RUN}", "set fit.likelihood: auto in the YAML and run again"))
    if data.discrepancy is None and not data.often_flagged and (data.n_frames or 0) >= _SEARCHED:
        found.append(Step(f"pchem discrepancy {RUN}", "search for effects missing from the model"))
    if not found:
        found.append(Step(f"pchem view {RUN}", "view every pixel in the browser"))
    return found


def _read_noise(data: ReportData) -> str:
    """Return the read noise to plan for, e-: the median's, or where most pixels are open a guess above it."""
    if data.mostly_flagged or not data.has_values("read_noise_e"):
        return "0.6"
    return f"{data.summary('read_noise_e').median:.2g}"
