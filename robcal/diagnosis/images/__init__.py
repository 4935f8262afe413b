"""What the images say: causes of cameras, targets and bodies."""
