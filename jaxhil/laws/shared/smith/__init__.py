"""Base of the Smith predictor and its hybrid."""
