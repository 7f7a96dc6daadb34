"""Hidden effects between the sense node and the pedestal: noise, coupling, response."""

import numpy as np

from hidden.base import Course, Hidden, telegraph


class RtsNoise(Hidden, s95=0.0035, scaling=(0.75, 0.75, 0.5), most=0.5):
    """One trap in the source follower of some pixels; strength: fraction of pixels.

    The trap is sampled when the reset and the signal are: once each (difference: three levels), N times each
    and averaged, or the signal alone, frame after frame (two levels, slow).
    """

    def draw(self):
        self.where = self.some_pixels(self.strength)
        n = self.where[0].size
        population = self.pick("amplitudes", "narrow", "lognormal", "exponential")
        if population == "narrow":
            self.amplitude = np.maximum(self.rng.normal(1.0, 0.2, n), 0.4)
        elif population == "lognormal":
            self.amplitude = np.exp(0.35 * self.rng.standard_normal(n))
        else:
            self.amplitude = 0.5 + self.rng.exponential(0.6, n)
        kind = self.pick("sampling", "difference", "averaged", "single", p=(0.6, 0.25, 0.15))
        self.reads = {"difference": 1, "averaged": self.rng.choice([2, 4]), "single": 0}[kind]
        self.parameters["reads"] = int(self.reads)
        # averaging makes the same trap quieter: those that show at all are larger
        self.amplitude *= max(self.reads, 1) ** 0.6
        self.occupied = self.rng.uniform(0.25, 0.75, n)
        # correlation of the trap from one read to the next, e^(-dt / tau)
        self.kept = np.exp(-1 / np.exp(self.rng.uniform(np.log(0.1), np.log(1.0), n)))
        if self.reads == 0:
            self.slow = np.stack(
                [telegraph(self.rng, self.sensor.n_frames, *self.rng.uniform(3, 80, 2)) for _ in range(n)],
                axis=1,
            )

    def _trap(self, n_reads: int) -> np.ndarray:
        """States at successive reads, (read, pixel); a fresh start in every frame."""
        n = self.occupied.size
        states = [self.rng.random(n) < self.occupied]
        for _ in range(n_reads):
            fresh = self.rng.random(n) < self.occupied
            states.append(np.where(self.rng.random(n) < self.kept, states[-1], fresh))
        return np.array(states[:-1], float)

    def noise(self, t, n, k):
        if self.reads:
            states = self._trap(2 * self.reads)
            jump = states[self.reads :].mean(axis=0) - states[: self.reads].mean(axis=0)
        else:
            jump = self.slow[max(t, 0)] - self.slow.mean(axis=0)
        n = n.copy()
        n[self.where] += self.amplitude * jump
        return n


class FlickerNoise(Hidden, s95=0.0009, most=0.9):
    """A part of each pixel's noise power is correlated in time; strength: that part."""

    def draw(self):
        if self.pick("spectrum", "one_time_constant", "one_over_f", p=(0.6, 0.4)) == "one_over_f":
            self.tau = np.array([3.0, 20.0, 130.0, 900.0])
        else:
            self.tau = np.array([self.between("tau_frames", 5, 200, log=True)])
        self.state = self.rng.standard_normal((self.tau.size, *self.sensor.shape))

    def noise(self, t, n, k):
        kept = np.exp(-1 / self.tau)[:, None, None]
        self.state = kept * self.state + np.sqrt(1 - kept**2) * self.rng.standard_normal(self.state.shape)
        slow = self.state.sum(axis=0) / np.sqrt(self.tau.size)
        return np.sqrt(1 - self.strength) * n + np.sqrt(self.strength) * self.sensor.noise * slow


class HeavyTailedNoise(Hidden, s95=6e-5, most=0.2):
    """Some samples of every pixel are noisier; strength: part of the samples at three times the noise."""

    def draw(self):
        self.law = self.pick("law", "mixture", "student", p=(0.7, 0.3))
        if self.law == "mixture":
            self.width = self.between("width", 2.7, 3.5)
        else:
            # the same excess kurtosis, 3 e (3^2 - 1)^2 = 6 / (nu - 4)
            self.nu = 4 + 6 / (192 * self.strength)
            self.parameters["degrees_of_freedom"] = float(self.nu)

    def noise(self, t, n, k):
        if self.law == "student":
            return n * np.sqrt((self.nu - 2) / self.rng.chisquare(self.nu, n.shape))
        return np.where(self.rng.random(n.shape) < self.strength, self.width * n, n)


class NoiseSkew(Hidden, s95=0.16, scaling=(1 / 6, 1 / 6, 1 / 6), most=0.95):
    """A part of the noise is exponential; strength: its time constant over the whole standard deviation."""

    def draw(self):
        self.side = self.sign()

    def noise(self, t, n, k):
        tail = self.rng.standard_exponential(n.shape) - 1
        return np.sqrt(1 - self.strength**2) * n + self.side * self.strength * self.sensor.noise * tail


class SignalDependentNoise(Hidden, s95=0.015, scaling=(0.25, 0.25, 0.25)):
    """Noise that grows with the electrons: variance s^2 k, or c k^2; strength: s, e- per root electron."""

    def draw(self):
        self.power = 0.5 if self.pick("grows_with", "root", "number", p=(0.7, 0.3)) == "root" else 1.0
        h = float(np.median(self.sensor.exposure))
        # the same mean variance in a typical pixel: E[K] = H, E[K^2] = H + H^2
        self.each = self.strength if self.power == 0.5 else self.strength / np.sqrt(1 + h)

    def noise(self, t, n, k):
        return n + self.each * k**self.power * self.rng.standard_normal(n.shape)


class Nonlinearity(Hidden, s95=0.0012, most=0.2):
    """The response bends; strength: relative change of the gain over 5 e-."""

    def draw(self):
        self.bend = self.sign(negative=0.7) * self.strength

    def signal(self, t, v):
        return v * (1 + self.bend * v / 5)


class InterpixelCapacitance(Hidden, s95=0.0004, most=0.1):
    """A part of the signal shows in the neighbours; strength: part per neighbour."""

    def draw(self):
        skew = 0.0
        if self.pick("symmetry", "isotropic", "anisotropic", p=(0.7, 0.3)) == "anisotropic":
            skew = self.between("anisotropy", -0.4, 0.4)
        self.x, self.y = self.strength * (1 + skew), self.strength * (1 - skew)

    def signal(self, t, v):
        right, down = np.diff(v, axis=1), np.diff(v, axis=0)
        v = v.copy()
        v[:, :-1] += self.x * right
        v[:, 1:] -= self.x * right
        v[:-1] += self.y * down
        v[1:] -= self.y * down
        return v


class AnalogMemory(Hidden, s95=0.0006, most=0.3, warmup=2):
    """A part of the signal of the frame before remains; strength: that part, the mean over the pixels."""

    def draw(self):
        self.before = np.zeros(self.sensor.shape)
        self.memory = np.full(self.sensor.shape, self.strength)
        if self.pick("pixels", "alike", "different", p=(0.7, 0.3)) == "different":
            s = self.between("spread", 0.3, 1.0)
            self.memory *= self.rng.lognormal(-(s**2) / 2, s, self.sensor.shape)

    def signal(self, t, v):
        before, self.before = self.before, v
        return v + self.memory * before


class GainDrift(Hidden, s95=0.0015):
    """The gain of all pixels drifts; strength: relative, end to end."""

    def draw(self):
        self.course = Course(self)

    def gain(self, t):
        return 1 + self.strength * self.course(t)
