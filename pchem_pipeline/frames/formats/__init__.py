"""One file a camera format."""
