"""Onset detection by a cumulative sum."""
