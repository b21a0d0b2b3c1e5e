"""Rehearsal of the rig on one machine, with two processes that exchange packets over UDP.

The *rig's process* simulates the hardware: drives, contact and sensors (`one_axis_rig`, `six_axis_rig`), runs
(`rig_task`), clock (`loop`) and network card (`network`). The *controller's process* is the program that a
bundle contains for use on the real rig (`udp_controller`, `udp_protocol`, `udp_task`). It runs the controller
and the numerical model of the docking (`numerical_model`, `numerical_model_six_axes`), and knows nothing of
the hardware. `session` starts the controller's process and finds the cause of each missed tick.
`session_report` evaluates the session.
"""
