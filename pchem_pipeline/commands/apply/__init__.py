"""``pchem apply``: other frames of a characterised sensor in physical units."""
