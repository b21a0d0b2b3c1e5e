"""Contact laws, and the ideal contact (without any delay) with which contacts on the rig are compared."""
