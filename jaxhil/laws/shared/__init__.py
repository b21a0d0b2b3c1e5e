"""Parts that several compensators use."""
