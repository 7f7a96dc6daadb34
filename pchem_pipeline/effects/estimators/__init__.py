"""Statistics that several effects use to guess their own strength."""
