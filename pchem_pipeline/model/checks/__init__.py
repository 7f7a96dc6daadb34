"""Statistical checks on many pixels: residuals, multiple testing, shrinkage, differences between runs."""
