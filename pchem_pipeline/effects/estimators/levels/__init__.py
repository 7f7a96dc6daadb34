"""Levels between which a signal jumps, and the share of the samples at each."""
