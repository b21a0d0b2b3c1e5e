"""Force of a virtual spring and damper at the desired position."""
