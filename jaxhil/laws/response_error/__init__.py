"""Response-error compensation with phase lead and identification of the contact."""
