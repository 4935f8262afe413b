"""Before physics: variance components, gross errors, exchanged numbers."""
