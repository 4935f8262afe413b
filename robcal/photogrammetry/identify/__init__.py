"""Which mark is which target."""
