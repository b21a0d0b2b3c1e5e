"""Impulse ledger: the law of this project. Its parts are the folders beside it."""
