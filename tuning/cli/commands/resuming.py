"""What commands that keep their finished pieces (`tuning.caches.pieces`) make and say of them."""

from pathlib import Path

from tuning import terminal
from tuning.caches.pieces import FOLDER, Pieces


def pieces_in(output: str, resume: bool) -> Pieces:
    """Those of a command that writes into the folder `output`."""
    return Pieces(Path(output) / FOLDER, resume)


def say_of_pieces(pieces: Pieces) -> None:
    """What did not go as a user may expect."""
    if number := len(pieces.other):
        kept = "piece was" if number == 1 else "pieces were"
        reason = "kept by other files, options or code, or damaged"
        terminal.note(f"warning: --resume: {number} {kept} {reason}: computed anew")
    if pieces.unwritten:
        terminal.note(f"warning: {pieces.unwritten[0]}: with --resume it would be computed again")
