"""Characterise deep sub-electron read noise image sensors with PCH-EM."""

from __future__ import annotations

__all__ = ["__version__"]

__version__ = "0.1.0"
