"""What an effect is, how it is found, composed and given evidence."""
