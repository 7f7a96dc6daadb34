"""Effects named on ready-made histograms, by likelihood."""
