"""Sensors like the one that was measured: its pixels fitted under a model, and replicates of them."""
