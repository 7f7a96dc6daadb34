"""Sets of effects at their best fit, and how they compare."""
