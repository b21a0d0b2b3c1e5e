"""Public functions of `tuning`, one per module.

Each function computes and returns the results that the command of the same name prints. Arguments are checked
before jax is imported; an unusable argument raises `InputError` with a message of one line.
"""
