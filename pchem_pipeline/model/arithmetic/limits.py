"""What is too small to count in double precision."""

#: Smallest probability, and smallest exposure, of which a logarithm is taken.
SMALLEST_MASS = 1e-300
#: Exponents below this are as good as 0.
LEAST_EXPONENT = -700.0
#: Share of a sum below which terms are lost in rounding.
NEGLIGIBLE = 1e-17
#: DN^2: smallest variance of a read noise without rounding.
LEAST_VARIANCE = 1e-6
