"""Smith predictor for the motion simulator's lag, with phase lead for the force delay."""
