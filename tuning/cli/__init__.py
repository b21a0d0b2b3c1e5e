"""Command-line interface of `jaxhil`: options, parser and commands."""
