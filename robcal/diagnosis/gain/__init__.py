"""What causes gain on data kept out."""
