"""Multi-parameter phase lead, by pole placement at the contact frequency."""
