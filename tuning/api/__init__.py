"""Functions behind `import tuning`, one per module.

They compute and return what the commands of the same names print. Arguments are checked before jax is
imported; an unusable argument raises `InputError` with a message of one line.
"""
