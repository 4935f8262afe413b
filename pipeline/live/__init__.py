"""A measurement campaign driven over the network: poses out, measurements in."""
