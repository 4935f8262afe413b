"""The first campaign.yaml for a folder of recordings."""
