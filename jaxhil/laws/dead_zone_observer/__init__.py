"""Dead zone observer: the force that a dead zone of the sensor holds back is estimated."""
