"""Base of the Smith predictor and of its hybrid with phase lead."""
