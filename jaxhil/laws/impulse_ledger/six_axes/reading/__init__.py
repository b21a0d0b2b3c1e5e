"""Reading of a tick: wrench about C, pose of the same age, gate, and means over free flight."""
