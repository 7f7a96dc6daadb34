"""Statistics of the numbers themselves: samples equal or near to others, of other pixels, or after bits."""
