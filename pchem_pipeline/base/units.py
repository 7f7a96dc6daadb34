"""Constants of the units that the package works in."""

from __future__ import annotations

#: DN^2: variance of rounding to whole DN, an error uniform over 1 DN
QUANTISATION_VARIANCE = 1.0 / 12.0
