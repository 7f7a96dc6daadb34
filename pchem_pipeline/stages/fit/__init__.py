"""Stage ``fit``: maximum likelihood for every pixel."""
