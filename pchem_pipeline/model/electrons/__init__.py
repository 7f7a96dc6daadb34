"""Electron numbers of samples under the fitted law of their pixel."""
