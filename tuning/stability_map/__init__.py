"""Stability maps: restitution error over two keys, theory, spectral radii, margins of the nominal point."""
