"""Parts of the impulse ledger in six axes; README.md states the method."""
