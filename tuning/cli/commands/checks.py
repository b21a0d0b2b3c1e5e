"""What commands check beside the front door's arguments; each raises `InputError`, one line. No jax here."""

from pathlib import Path

from jaxhil.errors import InputError, shown
from tuning.cli.options import PICTURES
from tuning.files import follow, writing


def picture(path: str) -> None:
    """A picture can be written there; folders on the way are made."""
    target = Path(path)
    if target.suffix.lower() not in PICTURES:
        raise InputError(f"--plot: found {shown(path)}, allowed a name that ends in {', '.join(PICTURES)}")
    with writing(target):
        follow(target).parent.mkdir(parents=True, exist_ok=True)
