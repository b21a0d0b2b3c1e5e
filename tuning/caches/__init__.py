"""Results and compiled programs on disk, and the fingerprints that tell whether they are still valid."""
