"""Design of experiments that identify a rig with approximately known parameters."""
