"""Parameter maps and what is derived from them."""
