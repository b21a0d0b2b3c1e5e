"""What leaves for the rig, and what stands in for a rig where there is none."""
