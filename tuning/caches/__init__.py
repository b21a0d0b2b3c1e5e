"""What is kept on disk lest it be computed twice, and what it follows from besides the input."""
