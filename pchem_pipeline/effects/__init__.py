"""What the PCD leaves out: a file for each operator, with the effects that it makes."""
