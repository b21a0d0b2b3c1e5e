"""Contact in a hardware-in-the-loop docking rig: its physics, and the controller that runs on it."""
