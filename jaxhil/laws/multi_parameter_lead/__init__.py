"""Multi-parameter phase lead, with gains from pole placement at the contact frequency."""
