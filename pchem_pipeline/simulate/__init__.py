"""The forward chain: from parameter maps to the frames of a camera, with keyed random numbers."""
