"""``pchem compare``: what differs between runs."""
