"""Detection of the onset of contact by a cumulative sum of force readings."""
