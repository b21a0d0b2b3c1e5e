"""Balance of impulses: onset of contact, reference trajectory, and the command that corrects the impulse."""
