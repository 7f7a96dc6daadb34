"""Hidden effects of the pedestal, the converter and the data path."""

import numpy as np

from hidden.base import Course, Hidden, telegraph


class BiasDrift(Hidden, s95=0.022):
    """The bias of all pixels drifts; strength: DN, end to end."""

    def draw(self):
        self.course = Course(self)

    def voltage(self, t, dn):
        return dn + self.strength * self.course(t)


class BiasJumps(Hidden, s95=0.021):
    """The bias of parts of the sensor jumps, each part at its own times; strength: height, DN."""

    def draw(self):
        (ny, nx), nt = self.sensor.shape, self.sensor.n_frames
        parts = self.pick("parts", "quadrants", "top_bottom", "left_right", p=(0.7, 0.15, 0.15))
        rows = (np.arange(ny) >= ny / 2)[:, None] * (parts != "left_right")
        columns = (np.arange(nx) >= nx / 2)[None, :] * (parts != "top_bottom")
        self.part = 2 * rows + columns
        rate = self.between("jumps_per_run", 3, 12)
        kind = self.pick("kind", "telegraph", "steps")
        self.course = np.zeros((nt, 4))
        for part in range(4):
            if kind == "telegraph":
                course = telegraph(self.rng, nt, nt / rate, nt / rate)
                if np.ptp(course) == 0:
                    course[self.rng.integers(nt // 5, nt - nt // 5) :] = 1 - course[0]
            else:
                steps = np.zeros(nt)
                times = self.rng.integers(nt // 20, nt - nt // 20, max(1, self.rng.poisson(rate / 2)))
                np.add.at(steps, times, self.rng.choice([-1.0, 1.0], times.size))
                course = np.cumsum(steps)
            self.course[:, part] = self.strength * (course - course.mean())

    def voltage(self, t, dn):
        return dn + self.course[max(t, 0)][self.part]


class FrameNoise(Hidden, s95=0.031, scaling=(0.5, 0.5, 0.25)):
    """All pixels of a frame share a deviation; strength: DN rms."""

    def voltage(self, t, dn):
        return dn + self.strength * self.rng.standard_normal()


class RowNoise(Hidden, s95=0.093, scaling=(0.25, 0.5, 0.25)):
    """All pixels of a row of a frame share a deviation; strength: DN rms."""

    def voltage(self, t, dn):
        return dn + self.strength * self.rng.standard_normal((dn.shape[0], 1))


class ColumnNoise(Hidden, s95=0.079, scaling=(0.5, 0.25, 0.25)):
    """All pixels of a column of a frame share a deviation; strength: DN rms."""

    def voltage(self, t, dn):
        return dn + self.strength * self.rng.standard_normal((1, dn.shape[1]))


class PeriodicPickup(Hidden, s95=0.023):
    """A sine picked up while rows are read; strength: amplitude, DN."""

    def draw(self):
        along = self.pick("along", "rows", "columns", "frames", p=(0.7, 0.15, 0.15))
        ny, nx = self.sensor.shape
        line = self.between("cycles_per_line", 0.03, 0.47) if along != "frames" else 0.0
        self.per_frame = self.between("cycles_per_frame", 0.03, 0.47)
        start = self.between("phase", 0, 2 * np.pi)
        place = np.arange(nx)[None, :] if along == "columns" else np.arange(ny)[:, None]
        self.place = 2 * np.pi * line * place + start

    def voltage(self, t, dn):
        return dn + self.strength * np.sin(self.place + 2 * np.pi * self.per_frame * t)


class ReadoutAlternation(Hidden, s95=0.006):
    """Even and odd frames differ, as with two banks of converters; strength: half the difference, DN."""

    def draw(self):
        self.half = self.sign() * self.strength

    def voltage(self, t, dn):
        return dn + (self.half if t % 2 == 0 else -self.half)


class AdcDnl(Hidden, order=2, s95=0.0015, most=0.9):
    """Codes of uneven width; strength: deviation of the width, LSB.

    A pattern that fewer codes carry, or an irregular one, is made stronger so that it is as visible as the
    alternation of all codes.
    """

    def draw(self):
        kind = self.pick("kind", "bit", "random", "one_code", "missing", p=(0.6, 0.25, 0.075, 0.075))
        codes = np.arange(2**self.sensor.bits + 2)
        if kind == "bit":
            bit = self.pick("bit", 0, 1, 2, 3, p=(0.4, 0.25, 0.2, 0.15))
            error = min(self.strength * np.sqrt(2.0**bit), 0.45)
            edges = self.sign() * error * ((codes >> bit) & 1)
        elif kind == "random":
            random = self.rng.standard_normal(codes.size)
            edges = np.clip(2.5 / np.sqrt(2) * self.strength * random, -0.4, 0.4)
        elif kind == "missing":
            period = int(self.pick("period", 11, 13, 19))
            edges = min(self.strength * np.sqrt(2 * period), 1.0) * (codes % period == 5)
        else:
            low, high = self.sensor.code_range
            code = int(self.rng.uniform(low + 0.1 * (high - low), high - 0.3 * (high - low)))
            wider = min(8 * self.strength, 0.45)
            edges = np.zeros(codes.size)
            edges[code : code + 2] = -wider / 2, wider / 2  # the next ones make up for it
            self.parameters["code"] = code
        self.edges = edges

    def convert(self, t, dn, code):
        lower, upper = code - 0.5 + self.edges[code], code + 0.5 + self.edges[code + 1]
        return code - (dn < lower) + (dn >= upper)


class AdcInl(Hidden, order=2, s95=0.016):
    """The converter's curve bends smoothly; strength: amplitude, LSB."""

    def draw(self):
        self.low, self.high = self.sensor.code_range
        if self.pick("kind", "sine", "cubic", p=(0.75, 0.25)) == "sine":
            self.turns, self.phase = self.between("turns", 1.2, 3.5), self.between("phase", 0, 2 * np.pi)
        else:
            self.turns = 0.0
        self.side = self.sign()

    def voltage(self, t, dn):
        u = (dn - self.low) / (self.high - self.low)
        if self.turns:
            return dn + self.strength * np.sin(2 * np.pi * self.turns * u + self.phase)
        w = 2 * np.clip(u, -0.2, 1.2) - 1
        # Chebyshev: within +-1 over the range
        return dn + self.side * self.strength * (4 * w**3 - 3 * w)


class Clipping(Hidden, s95=7e-6, scaling=(1.0, 1.0, 1.0), most=0.05):
    """Nothing below, or nothing above, one code; strength: part of the samples that it catches."""

    def draw(self):
        self.side = self.pick("side", "low", "high")

    def finish(self, frames):
        caught = self.strength * (6 / 7 if self.side == "low" else 8 / 7) * frames.size
        counts = np.bincount(frames.ravel(), minlength=2**self.sensor.bits)
        # beyond[c]: samples that a limit at code c would catch; the limit that comes nearest to what is asked
        way = 1 if self.side == "low" else -1
        beyond = np.concatenate([[0], np.cumsum(counts[::way])[:-1]])[::way]
        limit = int(np.argmin(np.abs(np.log(np.maximum(beyond, 0.01) / caught))))
        touched = frames < limit if self.side == "low" else frames > limit
        frames[touched] = limit
        self.affected = touched.any(axis=0)
        self.parameters |= {"limit_dn": limit, "samples": int(touched.sum())}


class RepeatedFrames(Hidden, s95=1.0, scaling=(0.0, 0.0, 0.0)):
    """Frames, or rows of frames, come twice; strength: number of frames."""

    def draw(self):
        n = max(1, round(self.strength))
        self.rows = slice(None)
        if self.pick("what", "frames", "rows", p=(0.8, 0.2)) == "rows":
            start = int(self.rng.integers(0, self.sensor.shape[0] // 2))
            self.rows = slice(start, start + self.sensor.shape[0] // 4)
        times = self.rng.choice(np.arange(1, self.sensor.n_frames), n, replace=False)
        self.times = set(times.tolist())
        self.parameters["frames"] = sorted(self.times)

    def record(self, t, frames):
        if t in self.times:
            frames[t, self.rows] = frames[t - 1, self.rows]


class PixelCorrection(Hidden, order=5, s95=0.05, most=1.0):
    """A sample far above its eight neighbours becomes their median; strength: share of those replaced.

    Far is so many standard deviations of the samples' own scatter.
    """

    def draw(self):
        scatter = np.sqrt(np.median(self.sensor.exposure)) * np.median(self.sensor.step)
        self.limit = int(self.between("threshold_sd", 2.0, 4.0) * scatter)
        self.parameters["threshold_dn"] = self.limit

    def convert(self, t, dn, code):
        around = [np.roll(code, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
        median = np.median(np.stack(around), axis=0).astype(code.dtype)
        replaced = (code - median > self.limit) & (self.rng.random(code.shape) < self.strength)
        # at the border some of the eight are missing
        replaced[[0, -1]] = False
        replaced[:, [0, -1]] = False
        return np.where(replaced, median, code)


class BitErrors(Hidden, order=4, s95=1e-3, most=1.0):
    """A bit of the converter reads 0, or its opposite, in some of the samples; strength: their share."""

    def draw(self):
        self.bit = int(self.pick("bit", 2, 3, 4))
        self.kind = self.pick("fault", "zero", "flip")

    def convert(self, t, dn, code):
        weight = 2**self.bit
        is_set = code // weight % 2 == 1
        wrong = np.where(is_set, code - weight, code if self.kind == "zero" else code + weight)
        return np.where(self.rng.random(code.shape) < self.strength, wrong, code)


class BinaryOffset(Hidden, order=3, s95=0.1, scaling=(0.25, 0.25, 0.25)):
    """An offset that follows one bit of the sample read before in the row; strength: DN."""

    def draw(self):
        self.bit = int(self.pick("bit", 0, 1, 2, 3))
        self.side = self.sign()

    def convert(self, t, dn, code):
        found = code.copy()
        for x in range(1, code.shape[1]):
            one = found[:, x - 1] // 2**self.bit % 2 == 1
            moved = dn[:, x] + self.side * self.strength * np.where(one, 0.5, -0.5)
            found[:, x] += (np.floor(moved + 0.5) - np.floor(dn[:, x] + 0.5)).astype(code.dtype)
        return found


class RepeatedLines(Hidden, order=6, s95=1e-4, scaling=(1.0, 0.0, 1.0), most=0.2):
    """Rows or columns that repeat the one before; strength: share of them."""

    def draw(self):
        self.axis = 0 if self.pick("lines", "rows", "columns") == "rows" else 1

    def convert(self, t, dn, code):
        lines = np.moveaxis(code, self.axis, 0)
        found = lines.copy()
        for y in np.flatnonzero(self.rng.random(len(lines) - 1) < self.strength) + 1:
            found[y] = lines[y - 1]
        return np.moveaxis(found, 0, self.axis)


class MisplacedLines(Hidden, order=6, s95=5e-3, most=0.3):
    """Rows or columns that hold the samples of other pixels; strength: share of them, or of the frames."""

    def draw(self):
        self.axis = 0 if self.pick("lines", "rows", "columns") == "rows" else 1
        self.move = self.pick("move", "swapped", "early", "late", "sample_lost", "sample_twice", "line_lost")
        if self.move in ("swapped", "line_lost"):  # lines are more alike than pixels of a line
            self.strength = min(16 * self.strength, self.most)

    def convert(self, t, dn, code):
        lines = np.moveaxis(code, self.axis, 0)
        found, (n, m) = lines.copy(), lines.shape
        if self.move == "line_lost":
            if self.rng.random() < self.strength:
                y = int(self.rng.integers(n - 1))
                found[y:-1] = lines[y + 1 :]
        elif self.move == "swapped":
            for y in np.flatnonzero(self.rng.random(n // 2) < 2 * self.strength) * 2:
                found[[y, y + 1]] = lines[[y + 1, y]]
        else:
            for y in np.flatnonzero(self.rng.random(n) < self.strength):
                x = int(self.rng.integers(m - 1)) if "sample" in self.move else 0
                if self.move in ("early", "sample_lost"):
                    found[y, x:-1] = lines[y, x + 1 :]
                else:
                    found[y, x + 1 :] = lines[y, x:-1]
        return np.moveaxis(found, 0, self.axis)


class GainStitch(Hidden, order=2, s95=3e-3, most=0.4):
    """Above a code the gain is another; strength: relative change.

    Both gains agree at that code, or at the black level: then there is a step.
    """

    def draw(self):
        low, high = self.sensor.code_range
        self.code = low + self.between("place", 0.5, 0.8) * (high - low)
        self.origin = self.code
        if self.pick("agree", "there", "black") == "black":
            # a step is seen far sooner than a kink
            self.origin, self.strength = self.sensor.bias.mean(), self.strength / 6
        self.change = self.sign() * self.strength

    def voltage(self, t, dn):
        return np.where(dn > self.code, dn + self.change * (dn - self.origin), dn)


class BlackClamp(Hidden, order=1, s95=0.018, scaling=(0.0, 0.0, 0.5), most=1.0):
    """The black level of a frame is taken from some of its pixels; strength: part of their mean taken off.

    They are the left eighth of the columns, the upper eighth of the rows, or all.
    """

    def draw(self):
        (ny, nx), s = self.sensor.shape, self.sensor
        where = self.pick("where", "columns", "rows", "all")
        rows = slice(max(ny // 8, 1)) if where == "rows" else slice(None)
        self.part = (rows, slice(max(nx // 8, 1)) if where == "columns" else slice(None))
        self.usual = (s.bias + s.step * s.exposure)[self.part].mean()

    def voltage(self, t, dn):
        return dn - self.strength * (dn[self.part].mean() - self.usual)


class ReadOrderNoise(Hidden, s95=0.07, scaling=(0.25, 0.5, 0.25)):
    """Noise of 1/f in the order of reading, of one tap or of four blocks of columns; strength: DN rms.

    Without what changes more slowly than once a frame, which an amplifier's clamp takes away.
    """

    def draw(self):
        ny, nx = self.sensor.shape
        self.taps = int(self.pick("taps", 1, 4, p=(0.7, 0.3)))
        # the more taps, the less is common to a row
        self.strength *= self.taps**0.5
        n = ny * (nx // self.taps)
        # one record goes on through the frames
        f = np.fft.rfftfreq(n * self.sensor.n_frames)
        spectrum = np.where(f * n >= 1, 1 / np.sqrt(np.maximum(f, 1e-12)), 0.0)
        self.record_of = []
        for _ in range(self.taps):
            phase = self.rng.standard_normal(f.size) + 1j * self.rng.standard_normal(f.size)
            noise = np.fft.irfft(spectrum * phase, n * self.sensor.n_frames)
            self.record_of.append((noise / noise.std()).astype(np.float32).reshape(-1, ny, nx // self.taps))

    def voltage(self, t, dn):
        dn = dn.copy()
        for i, record in enumerate(self.record_of):
            width = record.shape[2]
            dn[:, i * width : (i + 1) * width] += self.strength * record[max(t, 0)]
        return dn
