"""Stability maps and the report page for a review board."""
