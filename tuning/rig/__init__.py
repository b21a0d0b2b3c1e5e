"""What goes to the rig with a gain file, and what plays the rig."""
