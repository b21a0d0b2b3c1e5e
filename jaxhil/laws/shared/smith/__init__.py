"""Base classes of `smith_predictor` and `smith_hybrid`."""
