"""The limits that a gain file carries to the rig, and the watchdog's rates, from recorded runs."""
