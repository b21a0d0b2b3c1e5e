"""Reference trajectory and its sensitivities."""
