"""Effects that the package's library leaves out on purpose: whatever gets a name there is invented.

Which of them may be looked at, and which only once, at the end: ``scripts/bench/discrepancy_cases.py``.
"""

import numpy as np

from hidden.base import Hidden


class TemporalFilter(Hidden, s95=5e-3, most=1.0):
    """Samples averaged with the delivered one before, where those are alike; strength: their share."""

    before = None

    def convert(self, t, dn, code):
        found = code
        if self.before is not None:
            alike = np.abs(code - self.before) < 0.5 * np.median(self.sensor.step)
            chosen = alike & (self.rng.random(code.shape) < self.strength)
            found = np.where(chosen, (code + self.before) // 2, code)
        self.before = found
        return found


class RowDroop(Hidden, s95=0.03, scaling=(0.25, 0.25, 0.25), most=0.9):
    """The level of a row falls with the charge that the row holds (supply); strength: part of its mean."""

    def signal(self, t, v):
        return v - self.strength * v.mean(axis=1, keepdims=True)


class DistantCrosstalk(Hidden, s95=1e-3, most=0.2):
    """A sample gets a part of the one read some columns before (a pipeline); strength: that part."""

    def draw(self):
        self.columns = self.pick("columns", 4, 8)

    def signal(self, t, v):
        found = v.copy()
        found[:, self.columns :] += self.strength * v[:, : -self.columns]
        return found


class NoisyFrames(Hidden, s95=0.03, scaling=(0.5, 0.5, 0.25), most=1.5):
    """Read noise that is larger in one frame of thirty, by chance; strength: relative."""

    def draw(self):
        self.loud = self.rng.random(self.sensor.n_frames) < 1 / 30

    def noise(self, t, n, k):
        return n * (1 + self.strength * self.loud[max(t, 0)])


class SettlingRows(Hidden, s95=0.02, scaling=(0.25, 0.25, 0.25)):
    """Rows whose first pixels settle from the level of the row before; strength: part of it that is left."""

    def voltage(self, t, dn):
        last = (dn[:, -1] - self.sensor.bias[:, -1])[:-1, None]
        found = dn.copy()
        found[1:] += self.strength * last * 0.6 ** np.arange(dn.shape[1])
        return found


class TapGain(Hidden, s95=0.01, scaling=(0.25, 0.25, 0.25)):
    """The gain of one readout tap, a quarter of the columns, moves frame by frame; strength: relative."""

    def signal(self, t, v):
        v = v.copy()
        quarter = v.shape[1] // 4
        v[:, quarter : 2 * quarter] *= 1 + self.strength * self.rng.standard_normal()
        return v


class DeadTime(Hidden, s95=2e-3, most=0.1):
    """Electrons that come soon after another are lost; strength: part lost per electron already there."""

    def electrons(self, t, k):
        return k - self.rng.binomial(k, np.clip(self.strength * np.maximum(k - 1, 0), 0, 0.9))


class Hysteresis(Hidden, s95=0.05):
    """A sample is drawn towards the one delivered before, whatever its size; strength: DN."""

    before = None

    def convert(self, t, dn, code):
        found = code
        if self.before is not None:
            found = np.floor(dn + self.strength * np.sign(self.before - dn) + 0.5).astype(np.int64)
        self.before = found
        return found


class BlockMean(Hidden, s95=2e-3, most=1.0):
    """Blocks of 2 x 2 pixels that come as their mean (lossy compression); strength: their share."""

    def convert(self, t, dn, code):
        ny, nx = (size // 2 for size in code.shape)
        found = code.copy()
        blocks = found[: 2 * ny, : 2 * nx].reshape(ny, 2, nx, 2)
        lost = self.rng.random((ny, 1, nx, 1)) < self.strength
        mean = blocks.sum(axis=(1, 3), keepdims=True) // 4
        found[: 2 * ny, : 2 * nx] = np.where(lost, mean, blocks).reshape(2 * ny, 2 * nx)
        return found


class RowGain(Hidden, s95=0.01, scaling=(0.25, 0.5, 0.25)):
    """The gain of each row is drawn anew in every frame; strength: relative, rms."""

    def signal(self, t, v):
        return v * (1 + self.strength * self.rng.standard_normal((v.shape[0], 1)))


class Afterpulses(Hidden, s95=2e-3, most=0.5, warmup=20):
    """Each electron brings others into the next frame of its pixel; strength: their mean number."""

    before = 0

    def electrons(self, t, k):
        self.before = k + self.rng.poisson(self.strength * self.before, k.shape)
        return self.before


class RepelledCharge(Hidden, s95=1.5e-3, most=0.1):
    """Electrons that come to others go to the pixel on the right; strength: part per electron there."""

    def electrons(self, t, k):
        gone = self.rng.binomial(k, np.clip(self.strength * np.maximum(k - 1, 0), 0, 0.9))
        return k - gone + np.pad(gone[:, :-1], ((0, 0), (1, 0)))


class MainsGain(Hidden, s95=0.01, scaling=(0.5, 0.5, 0.25)):
    """A gain that swings with the mains while rows are read; strength: relative amplitude."""

    def draw(self):
        rows = np.arange(self.sensor.shape[0])[:, None]
        self.place = 2 * np.pi * self.between("cycles_per_line", 0.03, 0.4) * rows
        self.per_frame = self.between("cycles_per_frame", 0.05, 0.45)

    def signal(self, t, v):
        return v * (1 + self.strength * np.sin(self.place + 2 * np.pi * self.per_frame * t))


class BlendedFrames(Hidden, s95=2e-3, most=0.5):
    """Frames that are the mean of themselves and the one before; strength: share of the frames."""

    def record(self, t, frames):
        if t > 0 and self.rng.random() < self.strength:
            frames[t] = (frames[t].astype(np.int64) + frames[t - 1]) // 2


class BurstingBlock(Hidden, s95=0.5, scaling=(0.25, 0.25, 0.25)):
    """A block of pixels whose offset jumps together in one frame of twenty; strength: DN."""

    def draw(self):
        (ny, nx), side = self.sensor.shape, max(self.sensor.shape[0] // 6, 2)
        y, x = self.rng.integers(0, ny - side), self.rng.integers(0, nx - side)
        self.affected = np.zeros((ny, nx), bool)
        self.affected[y : y + side, x : x + side] = True

    def voltage(self, t, dn):
        return dn + self.strength * self.affected * (self.rng.random() < 0.05)


class RowTilt(Hidden, s95=0.15, scaling=(0.25, 0.5, 0.25)):
    """A slope along each row, drawn anew; strength: DN rms at its ends."""

    def voltage(self, t, dn):
        along = np.linspace(-1, 1, dn.shape[1])
        return dn + self.strength * self.rng.standard_normal((dn.shape[0], 1)) * along


class NoisyTime(Hidden, s95=0.05):
    """Read noise that is larger in a fifth of the run; strength: relative."""

    def draw(self):
        self.begin = self.between("begin", 0.1, 0.7) * self.sensor.n_frames

    def noise(self, t, n, k):
        return n * (1 + self.strength * (self.begin <= t < self.begin + self.sensor.n_frames / 5))


class EmptySamples(Hidden, s95=1e-3, most=0.2):
    """Samples that are read without their electrons; strength: their share."""

    def electrons(self, t, k):
        return np.where(self.rng.random(k.shape) < self.strength, 0, k)


class LoudColumn(Hidden, s95=0.25, scaling=(0.5, 0.25, 0.25)):
    """Columns whose pixels share a deviation from frame to frame, one in twelve; strength: DN rms."""

    def draw(self):
        self.loud = self.rng.random(self.sensor.shape[1]) < 1 / 12
        self.loud[self.rng.integers(self.loud.size)] = True

    def voltage(self, t, dn):
        return dn + self.strength * self.loud * self.rng.standard_normal(dn.shape[1])


class NegativeGhost(Hidden, s95=0.3, warmup=1):
    """Large samples leave the next frame of their pixel lower; strength: DN per electron above four."""

    before = 0.0

    def signal(self, t, v):
        before, self.before = self.before, v
        return v - self.strength / np.median(self.sensor.step) * np.maximum(before - 4, 0)
