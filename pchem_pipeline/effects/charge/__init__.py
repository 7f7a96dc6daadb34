"""Effects on the number of electrons."""
