"""Onset of contact, found by a cumulative sum."""
