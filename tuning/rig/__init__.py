"""The rig's loop over UDP: the controller as a process of its own, against a plant in plain floats."""
