"""Effects on the digital numbers."""
