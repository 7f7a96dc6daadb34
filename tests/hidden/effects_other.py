"""Hidden effects that a stationary dark stack cannot show, and some outside the package's library."""

import numpy as np

from hidden.base import Hidden


class ChargeLag(Hidden, s95=0.05, scaling=(0.0, 0.0, 0.0), most=0.4, warmup=40):
    """Each electron stays behind for a frame with probability q, and again; strength: q. Invisible."""

    def draw(self):
        self.left = np.zeros(self.sensor.shape, np.int64)

    def electrons(self, t, k):
        there = k + self.left
        self.left = self.rng.binomial(there, self.strength)
        return there - self.left


class ChargeDiffusion(Hidden, s95=0.05, scaling=(0.0, 0.0, 0.0), most=0.6):
    """Each electron moves to one of the four neighbours with probability q; strength: q. Invisible."""

    def electrons(self, t, k):
        stay = k.copy()
        arrived = np.zeros_like(k)
        left_over = 1.0
        for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
            moved = self.rng.binomial(stay, self.strength / 4 / left_over)
            left_over -= self.strength / 4
            stay -= moved
            shifted = np.roll(moved, way, axis)
            # what leaves the sensor does not come back on the other side
            shifted[(slice(None),) * axis + (0 if way == 1 else -1,)] = 0
            arrived += shifted
        return stay + arrived


class SpuriousCharge(Hidden, s95=0.075, scaling=(0.0, 0.0, 0.0)):
    """Electrons that no light and no dark current made; strength: e- per sample. Invisible."""

    def electrons(self, t, k):
        return k + self.rng.poisson(self.strength, k.shape)


class SelfTriggerCut(Hidden, s95=0.01, most=0.9):
    """Samples without an electron are partly not taken, but awaited anew; strength: that part."""

    def electrons(self, t, k):
        again = (k == 0) & (self.rng.random(k.shape) < self.strength)
        return np.where(again, self.rng.poisson(self.sensor.exposure), k)


class OutputCrosstalk(Hidden, s95=0.01, most=0.2):
    """The right half sees a part of what the left half's output reads at the same time; strength: part."""

    def draw(self):
        nx = self.sensor.shape[1]
        self.affected[:, : nx - nx // 2] = False

    def signal(self, t, v):
        v, half = v.copy(), v.shape[1] // 2
        v[:, v.shape[1] - half :] += self.strength * v[:, :half][:, ::-1]
        return v


class CheckerboardOffset(Hidden, s95=0.15, scaling=(0.25, 0.25, 0.25)):
    """Two colours of pixels, like a chessboard, swap the sign of an offset from frame to frame; DN."""

    def draw(self):
        y, x = np.indices(self.sensor.shape)
        self.colour = np.where((y + x) % 2 == 0, 1.0, -1.0)

    def voltage(self, t, dn):
        return dn + (self.strength if t % 2 == 0 else -self.strength) * self.colour


class HerringBone(Hidden, s95=0.05):
    """A sine picked up sample by sample, by one converter for all of them; strength: amplitude, DN.

    Its phase runs on from frame to frame, or is new in each. To be told as periodic pickup.
    """

    def draw(self):
        per_column = self.between("cycles_per_column", 0.03, 0.47)
        per_row = self.between("cycles_per_row", -0.47, 0.47)
        per_frame = self.between("cycles_per_frame", -0.47, 0.47)
        anew = self.pick("phase", "runs on", "new in each frame") == "new in each frame"
        frames = np.arange(self.sensor.n_frames)
        self.turns = self.rng.random(frames.size) if anew else per_frame * frames
        y, x = np.indices(self.sensor.shape)
        self.place = 2 * np.pi * (per_row * y + per_column * x)

    def voltage(self, t, dn):
        return dn + self.strength * np.sin(self.place + 2 * np.pi * self.turns[t])
