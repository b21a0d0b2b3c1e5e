"""Gates that open and close smoothly with the time of a crossing."""
