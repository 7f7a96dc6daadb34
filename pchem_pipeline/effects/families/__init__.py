"""What several effects have in common: an operator, of which each of them fixes the factors."""
