"""Force of a specified contact at the desired position."""
