"""Stage ``discrepancy``: find what the model is missing."""
