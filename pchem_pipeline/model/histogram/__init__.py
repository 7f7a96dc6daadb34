"""Histograms and summaries of frames."""
