"""The functions that `import tuning` offers, one a file: `tune`, `sweep`, `compare`, `map`,
`export`, `verify` and `report`.

They compute what the commands of those names compute and return it; the commands print it. Arguments are
checked before jax is imported, and whatever is wrong with one is an `InputError` of one line.
"""
