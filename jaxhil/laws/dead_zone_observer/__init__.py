"""Dead-zone observer: adds the force that the dead zone of the force sensor removes."""
