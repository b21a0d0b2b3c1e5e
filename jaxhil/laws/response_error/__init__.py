"""Phase lead, response error and identified contact."""
