"""The limits that a gain file carries to the rig, and the watchdog's rates of alarm, from recorded runs.

The watchdog itself, which trips the controller after a contact whose energy or restitution is wrong, is
`jaxhil.rig.watchdog`; here it is decided at what it trips.
"""
