"""Cameras, networks, bodies, discs and the eccentricity of their images."""
