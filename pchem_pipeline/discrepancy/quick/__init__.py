"""Quick look: tests of the model from the summaries that every run has."""
