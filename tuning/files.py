"""Files of ours, as `jaxhil.files` writes and reads them."""

from jaxhil.files import (
    TEMPORARY,
    follow,
    is_temporary,
    lock,
    make_folder,
    open_plain,
    read_sealed,
    remove_stale,
    write_sealed,
    write_whole,
    writing,
)

__all__ = [
    "TEMPORARY",
    "follow",
    "is_temporary",
    "lock",
    "make_folder",
    "open_plain",
    "read_sealed",
    "remove_stale",
    "write_sealed",
    "write_whole",
    "writing",
]
