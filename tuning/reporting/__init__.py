"""Report page for a review board."""
