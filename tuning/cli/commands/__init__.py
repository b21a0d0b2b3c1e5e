"""One module per command, each with `run(options) -> exit code`; imported when its command runs."""
