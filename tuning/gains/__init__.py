"""Tuning of a compensator's gains: objective, search and evaluation of the tuned gains."""
