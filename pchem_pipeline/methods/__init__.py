"""Other ways to characterise a pixel beside PCH-EM: one file a method, arrays in and arrays out."""
