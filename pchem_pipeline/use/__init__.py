"""What is done with a characterised sensor: calibrated frames, electron numbers, exposures."""
