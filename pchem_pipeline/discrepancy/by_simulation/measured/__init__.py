"""What no known effect explains, measured in the samples: moves, noise, gain, electrons, responses."""
