"""Identification of effects in frames by simulation: fingerprints, replicates, sets."""
