"""The statistics: arrays in, arrays out; compiled loops in ``*_numba.py`` beside their API."""
