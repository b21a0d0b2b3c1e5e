"""Design of excitations for a rig with roughly known parameters."""
