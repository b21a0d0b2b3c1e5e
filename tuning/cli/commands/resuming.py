"""Checkpoints of finished work (`tuning.caches.pieces`): creation for a command, and warnings."""

from pathlib import Path

from tuning import terminal
from tuning.caches.pieces import FOLDER, Pieces


def pieces_in(output: str, resume: bool) -> Pieces:
    """Return the checkpoints of a command that writes into the folder `output`."""
    return Pieces(Path(output) / FOLDER, resume)


def say_of_pieces(pieces: Pieces) -> None:
    """Warn of checkpoints that could not be used or written."""
    if number := len(pieces.other):
        subject = "piece was" if number == 1 else "pieces were"
        reason = "kept by other files, options or code, or damaged"
        terminal.note(f"warning: --resume: {number} {subject} {reason}: computed anew")
    if pieces.unwritten:
        terminal.note(f"warning: {pieces.unwritten[0]}: with --resume it would be computed again")
