"""Shadow mode: computation of the commands that a controller would have given on a log's readings."""
