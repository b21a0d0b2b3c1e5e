"""A rehearsal of the rig on one machine: two processes that exchange packets over UDP.

The *rig's process* plays what is hardware on a rig: drives, contact and sensors (`plant`, `hardware`), its
clock (`loop`) and its network card (`network`). The *controller's process* is what leaves for the rig in a
bundle (`udp_controller`, `udp_protocol`): it holds the controller and the numerical model of the docking, and
knows nothing of the hardware. `session` starts the second from the first and finds out whose fault a missed
tick was; `report` judges the session.
"""
