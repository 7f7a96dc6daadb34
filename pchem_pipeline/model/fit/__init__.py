"""Maximum likelihood of a pixel's parameters from its histograms."""
