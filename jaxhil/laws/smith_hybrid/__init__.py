"""Mean of Smith predictor and phase lead."""
