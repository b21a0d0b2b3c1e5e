"""Lead of the commanded position by the inverse of the motion simulator."""
