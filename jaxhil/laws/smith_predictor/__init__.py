"""Smith predictor behind a phase lead."""
