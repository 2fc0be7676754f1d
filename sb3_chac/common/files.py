"""Files that outlive a process that is killed, and their checksums."""

import io
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np

BLOCK = 2**16  # bytes


class SparseWriter(io.BufferedWriter):
    """
    A file in which blocks of zeros are left out (they are read as zeros): SB3's ReplayBuffer is stored with the rows that are
    not in use yet, which may be gigabytes. The last byte written must not be zero; that of a pickle never is. ``crc`` is the
    checksum of all that was written.
    """

    crc = 0

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        self.crc = zlib.crc32(view, self.crc)
        for start in range(0, len(view), BLOCK):
            block = view[start : start + BLOCK]
            if np.frombuffer(block, dtype=bool).any():
                super().write(block)
            else:
                self.seek(len(block), os.SEEK_CUR)
        return len(view)


def sync(path: Path) -> None:
    """
    Flush a file or folder to the disk.

    :param path: a file or folder, what is in it is on the disk when this returns (Windows cannot do so with folders)
    """
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_safely(file: Path, content: bytes) -> None:
    """
    Replace a file in one go.

    :param file: holds what it held before, or all of ``content``, whenever the process is killed
    """
    temporary = file.with_name(file.name + ".tmp")
    temporary.write_bytes(content)
    sync(temporary)
    os.replace(temporary, file)


def checksum(path: Path) -> tuple[int, bytes]:
    """
    Compute the checksum of a file.

    :return: that of a file, and its last byte
    """
    crc, last = 0, b""
    with path.open("rb") as file:
        while block := file.read(2**22):
            crc, last = zlib.crc32(block, crc), block[-1:]
    return crc, last
