"""Virtual contact: a virtual spring and damper act on the numerical model."""
