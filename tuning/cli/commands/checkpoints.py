"""Checkpoints of finished work (`tuning.caches.checkpoints`): creation for a command, and warnings."""

from pathlib import Path

from tuning import terminal
from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints


def open_checkpoints(output: str, resume: bool) -> Checkpoints:
    """Return the checkpoints of a command that writes into the folder `output`."""
    return Checkpoints(Path(output) / CHECKPOINT_FOLDER, resume)


def warn_about_checkpoints(pieces: Checkpoints) -> None:
    """Warn of checkpoints that could not be used or written."""
    if number := len(pieces.other):
        subject = "piece was" if number == 1 else "pieces were"
        reason = "kept by other files, options or code, or damaged"
        terminal.note(f"warning: --resume: {number} {subject} {reason}: computed anew")
    if pieces.unwritten:
        terminal.note(f"warning: {pieces.unwritten[0]}: with --resume it would be computed again")
