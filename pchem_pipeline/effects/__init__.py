"""What the PCD leaves out: one file per effect, in a folder per plane of the signal chain."""
