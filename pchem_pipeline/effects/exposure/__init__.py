"""Effects on the mean number of electrons per frame."""
