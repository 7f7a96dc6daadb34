"""The law of a pixel's samples: density, masses of codes, scores."""
