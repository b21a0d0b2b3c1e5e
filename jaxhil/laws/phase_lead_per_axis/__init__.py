"""Phase lead with a lead time for each channel of the wrench."""
