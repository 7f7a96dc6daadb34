"""Arithmetic of the compiled loops: values side by side, and masses of the normal law."""
