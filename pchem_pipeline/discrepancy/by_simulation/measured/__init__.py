"""Empirical descriptions of unexplained data: shifts, noise, gain, electron numbers, responses."""
