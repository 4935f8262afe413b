"""From the images of a body to its adjusted coordinates."""
