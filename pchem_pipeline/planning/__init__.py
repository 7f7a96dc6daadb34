"""How many frames are enough, at which exposure, and how to divide them, from the Cramer-Rao bound."""
