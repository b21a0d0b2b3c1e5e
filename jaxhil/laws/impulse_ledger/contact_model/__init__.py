"""Contact model: force-penetration model that is estimated from the readings during a contact."""
