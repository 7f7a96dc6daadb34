"""PCH-EM in plain numpy, straight from the paper's equations, on raw samples.

Nothing here is shared with the package: every sample has its own row of membership probabilities, and
all components up to a generous last one. Slow and obvious.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

Array = NDArray[np.float64]


class Theta(NamedTuple):
    """(H, g, mu, sigma)."""

    exposure: float
    gain: float
    bias: float
    sigma: float


def log_joint(x: Array, theta: Theta) -> Array:
    """Logarithm of each term of eq. X_density, shape (N, k)."""
    last = int(
        theta.exposure + 15 * np.sqrt(theta.exposure) + 25 + max(0.0, (x.max() - theta.bias) * theta.gain)
    )
    k = np.arange(last + 1)
    log_poisson = k * np.log(theta.exposure) - theta.exposure - gammaln(k + 1)
    e = (x[:, None] - theta.bias - k / theta.gain) / theta.sigma
    return log_poisson - 0.5 * e**2 - np.log(theta.sigma) - 0.5 * np.log(2 * np.pi)


def log_likelihood(x: Array, theta: Theta) -> float:
    """Sum of log f_X over the sample."""
    return float(logsumexp(log_joint(x, theta), axis=1).sum())


def em_step(x: Array, theta: Theta) -> Theta:
    """Eqs. gamma_nk, update_matrices and update_eqns."""
    joint = log_joint(x, theta)
    gamma = np.exp(joint - logsumexp(joint, axis=1, keepdims=True))
    k = np.arange(gamma.shape[1])
    mean_k = gamma @ k
    a, b, c = float(mean_k.mean()), float((gamma @ k**2).mean()), float((x * mean_k).mean())
    gain = (b - a**2) / (c - x.mean() * a)
    variance = (x**2).mean() - x.mean() ** 2 - (b - a**2) / gain**2
    return Theta(a, gain, x.mean() - a / gain, float(np.sqrt(variance)))


def em(x: Array, theta: Theta, n_iterations: int) -> list[Theta]:
    """The start and the iterates."""
    path = [theta]
    for _ in range(n_iterations):
        path.append(em_step(x, path[-1]))
    return path
