"""Charts: curves, bars and points described once, and drawn on paper and on the page."""
