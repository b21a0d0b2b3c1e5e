"""Phase lead with a lead for each channel of the wrench."""

AXES = (6,)
