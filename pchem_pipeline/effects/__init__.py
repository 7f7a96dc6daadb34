"""What the PCD leaves out: a file per effect or family, in a folder per plane of the signal chain."""
