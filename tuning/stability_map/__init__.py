"""Stability maps: restitution error on a grid of two keys, theory, spectral radii, nominal margins."""
