"""What each effect guesses about itself and would do to the statistics."""
