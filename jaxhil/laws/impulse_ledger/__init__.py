"""Impulse ledger: this project's own compensator.

The parts for one axis, in the order in which a reader needs them:

1. `rig.py` states the method and connects the parts.
2. `alignment` delays the measured position like the force.
3. `onset_detection` estimates bias and noise in free flight, and detects the contact.
4. `contact_model` fits a force-penetration model to the readings, and estimates the force delay.
5. `reference_trajectory` computes the motion that the numerical model should have, and predicts it.
6. `specified.py` and the table in `simulation.py` compute the gains' nominal values from the mechanism file.

In each folder, `rig.py` is the scalar code of the rig with equations and sources. `simulation.py` is the same
computation in JAX, for batches. `six_axes/README.md` states the method in six axes, which has separate parts.
"""
