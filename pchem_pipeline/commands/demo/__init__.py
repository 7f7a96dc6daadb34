"""``pchem demo``: simulated sensors through the whole pipeline, beside their truth."""
