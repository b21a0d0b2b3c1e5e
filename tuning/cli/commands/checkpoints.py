"""Creation of a command's checkpoints (`tuning.caches.checkpoints`), and warnings of unusable ones."""

from pathlib import Path

from tuning import terminal
from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints


def open_checkpoints(output: str, resume: bool) -> Checkpoints:
    """Return the checkpoints of a command whose results are written to the folder `output`.

    If `resume` is true, checkpoints of an earlier run are used.
    """
    return Checkpoints(Path(output) / CHECKPOINT_FOLDER, resume)


def warn_about_checkpoints(checkpoints: Checkpoints) -> None:
    """Print a warning if checkpoints could not be used or could not be written."""
    if number := len(checkpoints.other):
        subject = "checkpoint is" if number == 1 else "checkpoints are"
        reason = "from other files, options or code, or damaged"
        terminal.note(f"warning: --resume: {number} {subject} {reason}: this work was done again")
    if checkpoints.unwritten:
        terminal.note(f"warning: {checkpoints.unwritten[0]}: --resume would repeat this work")
