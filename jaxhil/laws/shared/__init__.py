"""Parts that several compensators have in common."""
