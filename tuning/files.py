"""Files of ours, as `jaxhil.files` writes and reads them."""

from jaxhil.files import (
    TEMPORARY,
    exchange,
    follow,
    is_temporary,
    lock,
    make_folder,
    open_plain,
    read_sealed,
    remove_stale,
    sync_folder,
    temporary_name,
    write_sealed,
    write_whole,
    writing,
)

__all__ = [
    "TEMPORARY",
    "exchange",
    "follow",
    "is_temporary",
    "lock",
    "make_folder",
    "open_plain",
    "read_sealed",
    "remove_stale",
    "sync_folder",
    "temporary_name",
    "write_sealed",
    "write_whole",
    "writing",
]
