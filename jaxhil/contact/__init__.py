"""Contact laws, contact with one surface or two, and the ideal (undelayed) contact as the reference."""
