"""The controller of the rig held against the simulation: runs recorded tick by tick, and replayed."""
