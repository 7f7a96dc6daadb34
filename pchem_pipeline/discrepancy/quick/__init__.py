"""A quick look at what the model leaves out, from the summaries that every run has."""
