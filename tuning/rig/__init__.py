"""Rehearsal of the rig on one machine, with two processes that exchange packets over UDP.

The *rig's process* simulates the hardware: drives, contact and sensors (`plant`, `rig_task`), clock (`loop`)
and network card (`network`). The *controller's process* is the one that a bundle takes to the rig
(`udp_controller`, `udp_protocol`); it holds the controller and the numerical model of the docking, without
knowledge of the hardware. `session` starts the second process from the first and finds the cause of missed
ticks; `session_report` evaluates the session.
"""
