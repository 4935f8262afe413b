"""What is wrong with a campaign, or doubtful: all of it at once, before any long work."""
