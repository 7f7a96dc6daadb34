"""One look: palette, axes, map stretch, numbers in words, pictures as files."""
