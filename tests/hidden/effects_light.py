"""Hidden effects of the light, the dark current and the electrons."""

import numpy as np

from hidden.base import Course, Hidden, telegraph


class ExposureDrift(Hidden, s95=0.004):
    """The exposure of all pixels drifts; strength: relative, end to end."""

    def draw(self):
        self.course = Course(self)

    def exposure(self, t, h):
        return h * (1 + self.strength * self.course(t))


class Persistence(Hidden, s95=0.1):
    """The image of an earlier exposure fades; strength: e- per frame at its brightest, first frame.

    The study has no s95 for it. A tenth of the pixels at 0.1 e- shifts the trend of the frame means by about
    six standard errors.
    """

    def draw(self):
        ny, nx = self.sensor.shape
        y, x = np.meshgrid(np.arange(ny) / ny, np.arange(nx) / nx, indexing="ij")
        kind = self.pick("pattern", "disc", "bar", "spots")
        cy, cx = self.rng.uniform(0.25, 0.75, 2)
        if kind == "disc":
            image = np.hypot(y - cy, x - cx) < self.rng.uniform(0.15, 0.3)
        elif kind == "bar":
            image = np.abs((y - cy) if self.rng.random() < 0.5 else (x - cx)) < self.rng.uniform(0.06, 0.15)
        else:
            image = np.zeros((ny, nx))
            for _ in range(self.rng.integers(4, 10)):
                sy, sx, width = *self.rng.random(2), self.rng.uniform(0.02, 0.06)
                image += np.exp(-((y - sy) ** 2 + (x - sx) ** 2) / (2 * width**2))
        self.image = image / max(image.max(), 1e-9)
        self.affected = self.image > 0.1
        n = self.sensor.n_frames
        self.tau = self.rng.uniform([0.02, 0.15], [0.1, 0.6]) * n
        self.share = self.rng.dirichlet([1.0, 3.0])
        self.parameters |= {"tau_frames": self.tau.tolist(), "share": self.share.tolist()}

    def exposure(self, t, h):
        left = float(self.share @ np.exp(-max(t, 0) / self.tau))
        return h + self.strength * left * self.image


class DarkCurrentRts(Hidden, s95=0.0027, scaling=(0.75, 0.75, 0.5), most=0.3):
    """The dark current of some pixels blinks; strength: fraction of pixels."""

    def draw(self):
        self.where = self.some_pixels(self.strength)
        n, nt = self.where[0].size, self.sensor.n_frames
        median = self.between("median_step_e", 0.5, 1.0)
        defects = self.pick("levels", 2, 3, p=(0.75, 0.25)) - 1
        self.extra = np.zeros((nt, n))
        for i in range(n):
            for _ in range(defects):
                tau = np.exp(self.rng.uniform(np.log(20), np.log(max(nt / 10, 40)), 2))
                step = median * np.exp(0.35 * self.rng.standard_normal())
                self.extra[:, i] += step * telegraph(self.rng, nt, *tau)

    def exposure(self, t, h):
        h = h.copy()
        h[self.where] += self.extra[max(t, 0)]
        return h


class ExposureFlicker(Hidden, s95=0.005, scaling=(0.5, 0.5, 0.25), most=0.3):
    """The exposure of all pixels varies from frame to frame; strength: relative, rms."""

    def draw(self):
        law = self.pick("law", "normal", "uniform", "two_level")
        n = self.sensor.n_frames
        if law == "normal":
            deviation = self.rng.standard_normal(n)
        elif law == "uniform":
            deviation = self.rng.uniform(-np.sqrt(3), np.sqrt(3), n)
        else:
            deviation = self.rng.choice([-1.0, 1.0], n)
        self.factor = np.maximum(1 + self.strength * deviation, 0)

    def exposure(self, t, h):
        return h * self.factor[max(t, 0)]


class OverdispersedCounts(Hidden, s95=0.0016):
    """The exposure varies from sample to sample: Var K = H + a H^2; strength: a."""

    def draw(self):
        self.law = self.pick("law", "gamma", "lognormal", p=(0.6, 0.4))

    def exposure(self, t, h):
        if self.law == "gamma":
            return h * self.rng.standard_gamma(1 / self.strength, h.shape) * self.strength
        width = np.sqrt(np.log1p(self.strength))
        return h * np.exp(width * self.rng.standard_normal(h.shape) - width**2 / 2)


class BranchingCounts(Hidden, s95=0.0013, most=0.5):
    """Each electron sets free Poisson(l) more in the same pixel, and those again; strength: l."""

    def electrons(self, t, k):
        total, young = k.copy(), k
        while young.any():
            young = self.rng.poisson(self.strength * young)
            total += young
        return total


class OpticalCrosstalk(Hidden, s95=0.0028, most=0.5):
    """Each electron sets one free in one of the four neighbours with probability p; strength: p."""

    def electrons(self, t, k):
        emitted = self.rng.binomial(k, self.strength)
        places = np.repeat(np.argwhere(emitted), emitted[emitted > 0], axis=0)
        places += np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])[self.rng.integers(0, 4, len(places))]
        inside = ((places >= 0) & (places < k.shape)).all(axis=1)
        k = k.copy()
        np.add.at(k, tuple(places[inside].T), 1)
        return k


class CosmicRays(Hidden, s95=0.003, scaling=(0.0, 0.0, 1.0)):
    """Particles cross some frames; strength: tracks per frame."""

    def draw(self):
        self.alpha = self.between("alpha_share", 0.0, 0.4)
        # 80 electrons per micrometre of silicon, pixels of 1.1 to 4 micrometres
        self.per_pixel = 80 * self.between("pixel_um", 1.1, 4.0)
        expected = self.strength * self.sensor.n_frames
        n = max(1, self.rng.poisson(expected), round(expected / 2))
        self.hits = np.bincount(self.rng.integers(0, self.sensor.n_frames, n), minlength=self.sensor.n_frames)
        self.parameters["tracks"] = int(n)

    def _deposit(self) -> np.ndarray:
        ny, nx = self.sensor.shape
        cy, cx = self.rng.uniform(0, ny), self.rng.uniform(0, nx)
        charge = np.zeros((ny, nx))
        if self.rng.random() < self.alpha:
            y, x = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
            width = self.rng.uniform(0.5, 1.3)
            return 3000 * np.exp(-((y + 0.5 - cy) ** 2 + (x + 0.5 - cx) ** 2) / (2 * width**2))
        length = np.exp(self.rng.normal(np.log(4), 0.7))
        angle = self.rng.uniform(0, 2 * np.pi)
        along = np.arange(0, max(length, 0.5), 0.05)
        y, x = (cy + along * np.sin(angle)).astype(int), (cx + along * np.cos(angle)).astype(int)
        inside = (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
        np.add.at(charge, (y[inside], x[inside]), 0.05 * self.per_pixel)
        return charge * np.exp(0.3 * self.rng.standard_normal(charge.shape))

    def electrons(self, t, k):
        for _ in range(self.hits[t] if t >= 0 else 0):
            k = k + self.rng.poisson(self._deposit())
        return k


class Glow(Hidden, s95=0.25, scaling=(0.5, 0.5, 0.25)):
    """Light from a corner or an edge, in one frame of fifty or growing; strength: e- there."""

    def draw(self):
        (ny, nx), n = self.sensor.shape, self.sensor.n_frames
        y, x = np.indices((ny, nx))
        corner = self.pick("from", "corner", "edge")
        cy = 0.0 if corner == "corner" else self.between("row", 0.2, 0.8) * ny
        away = np.hypot(y - cy, x)
        reach = max(ny, nx) / 5
        power = 1 if self.pick("falloff", "exponential", "gaussian", p=(0.7, 0.3)) == "exponential" else 2
        self.shape = np.exp(-((away / reach) ** power) / power)
        self.affected = self.shape > 0.1
        if self.pick("course", "bursts", "grows", p=(0.7, 0.3)) == "bursts":
            self.size = self.rng.random(n) < 0.02
            self.parameters["bursts"] = int(self.size.sum())
        else:
            self.size, self.strength = np.arange(n) / n, self.strength / 4

    def exposure(self, t, h):
        return h + self.strength * self.shape * self.size[max(t, 0)]


class Trapping(Hidden, s95=0.005, most=0.9, warmup=60):
    """A trap that holds one electron at most; strength: chance that an empty one catches one of a sample.

    Of traps in some pixels only, each catches the oftener.
    """

    def draw(self):
        self.release = self.between("release", 0.1, 0.6)
        self.full = np.zeros(self.sensor.shape, bool)
        if self.pick("pixels", "all", "some", p=(0.7, 0.3)) == "some":
            share = self.between("share", 0.1, 0.5)
            self.some_pixels(share)
            self.strength = min(self.strength / share, self.most)

    def electrons(self, t, k):
        freed = self.full & (self.rng.random(k.shape) < self.release)
        caught = self.affected & ~self.full & (k > 0) & (self.rng.random(k.shape) < self.strength)
        self.full = (self.full & ~freed) | caught
        return k + freed - caught
