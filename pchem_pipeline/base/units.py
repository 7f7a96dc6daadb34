"""Constants of the units that the package works in."""

#: DN^2: variance of rounding to whole DN, an error uniform over 1 DN
QUANTISATION_VARIANCE = 1.0 / 12.0
#: DN per electron, below which a DN is no small part of an electron
FEW_STEP = 3.0
