"""Contact: force laws, contact with one surface or two, and the same contact in space (the reference)."""
