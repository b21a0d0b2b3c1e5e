"""Stability maps: error over two keys, theory and growth, margins around the nominal point."""
