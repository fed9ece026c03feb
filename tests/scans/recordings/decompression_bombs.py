"""Streams of a few kilobytes that unpack to gigabytes."""

import struct


def zstd_zeros(size: int, *, stated: bool) -> bytes:
    """A frame of zstd that unpacks to `size` zeros, a multiple of 128 KiB; `stated`: its header says so.

    Blocks of type 1 repeat one byte: three bytes of header (last block, two bits of type, 21 bits of size), and it.
    """
    block = 128 * 1024
    count = size // block
    assert size == count * block
    header = b"\xc0\x38" + struct.pack("<Q", size) if stated else b"\x00\x38"  # a window of 128 KiB
    blocks = struct.pack("<I", block << 3 | 1 << 1)[:3] + b"\0"
    last = struct.pack("<I", block << 3 | 1 << 1 | 1)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd" + header + blocks * (count - 1) + last
