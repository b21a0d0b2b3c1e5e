"""Reference trajectory: desired motion of the numerical model at the time of the force readings."""
