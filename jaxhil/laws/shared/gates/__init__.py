"""Gates that open and close smoothly when a threshold is crossed."""
