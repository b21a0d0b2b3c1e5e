"""Phase lead in six axes, with a separate lead time for each channel of the wrench."""
