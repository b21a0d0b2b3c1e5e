"""Parts of the impulse ledger in six axes; README.md in this folder states the method."""
