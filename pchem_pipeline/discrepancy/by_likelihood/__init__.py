"""Identification of effects in ready-made histograms by likelihood."""
