"""Tracks and clouds of particles: rate, electrons and width against theory."""

import dataclasses

import numpy as np
from helpers.small_sensors import a_sensor, simulated

from pchem_pipeline.effects.operators.strike import CosmicRays


def test_tracks_come_at_their_rate_and_leave_their_electrons():
    effect = CosmicRays(tracks_per_frame=0.4, length_um=6.0, electrons_per_um=50.0, pixel_pitch_um=3.0)
    n = 2000
    total = _electrons(effect, (50, 50), 0, n).sum(axis=(1, 2))
    hit = total > 0
    rate = 1 - np.exp(-0.4)
    assert abs(hit.mean() - rate) < 5 * np.sqrt(rate * (1 - rate) / n) + 0.01
    # an exponential length has E[l^2] = 2 E[l]^2; a track that crosses the edge loses half at the most
    mean, edge = 0.4 * 6.0 * 50.0, 4 * 2.0 / 50 / np.pi
    error = np.sqrt(0.4 * (2 * 300.0**2 + 300.0) / n)
    assert abs(total.mean() - mean * (1 - edge)) < 5 * error + mean * edge
    # the pixels of the first track touch each other
    k = _electrons(CosmicRays(tracks_per_frame=0.01, length_um=60.0), (60, 60), 0, 400)
    y, x = np.nonzero(k[np.flatnonzero(k.sum(axis=(1, 2)))[0]])
    assert y.size > 3
    steps = abs(y[:, None] - y) + abs(x[:, None] - x) + 99 * np.eye(y.size)
    assert steps.min(axis=1).max() <= 2


def test_clouds_of_particles_have_their_electrons_and_width():
    effect = CosmicRays(tracks_per_frame=1e-2, cloud_share=1.0, cloud_electrons=9000.0, cloud_um=2.4)
    frames = _electrons(effect, (60, 60), 0, 4000)
    y, x = np.indices((60, 60))
    inside, totals, variances = 0, [], []
    for k in frames[frames.sum(axis=(1, 2)) > 0]:
        cy, cx = (float((k * axis).sum() / k.sum()) for axis in (y, x))
        if min(cy, cx) > 5 and max(cy, cx) < 54 and k[round(cy), round(cx)] > 500:
            inside += 1
            totals.append(k.sum())
            variances.append((k * (x - cx) ** 2).sum() / k.sum())
    assert inside > 10
    assert abs(np.mean(totals) / 9000 - 1) < 5 / np.sqrt(9000 * inside) + 1e-3
    # 0.8 pixels, and where in its pixel an electron is
    assert abs(np.mean(variances) - 0.64 - 1 / 12) < 0.03


def _electrons(effect, shape, first, last):
    truth = dataclasses.replace(a_sensor(shape), quanta_exposure=np.zeros(shape))
    return simulated(truth, effect, n_frames=last, frames=(first, last))[1]
