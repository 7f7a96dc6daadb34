"""The distribution of all pixels' samples, predicted from the parameter maps."""
