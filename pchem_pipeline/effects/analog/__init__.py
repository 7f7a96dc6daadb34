"""Effects on the input-referred analog signal."""
