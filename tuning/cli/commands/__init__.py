"""Commands of `jaxhil`: each module has a function `run(options)`, which returns the exit code."""
