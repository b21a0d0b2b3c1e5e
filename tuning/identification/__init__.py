"""From a rig's logs to a mechanism file: what the numbers of a rig are, and how well the logs tell them."""
