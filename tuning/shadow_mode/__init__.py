"""Shadow mode: what a controller would have commanded on the readings in a rig's logs."""
