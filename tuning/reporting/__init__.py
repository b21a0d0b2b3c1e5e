"""Report for a review board: an HTML page with the results of all commands."""
