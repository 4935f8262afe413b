"""Target sheets to print, and what can be read in images of them."""
