"""Effects on the signal at the ADC, before rounding."""
