"""The attachment of every sample on zenoh: 32 bytes that say which sample of which run of the server it is. A leaf.

boot id (16 bytes, UUID) | tick index u64 | sequence number u64, counted per topic from 0 |    little endian
"""

import struct
from dataclasses import dataclass
from uuid import UUID

_LAYOUT = struct.Struct("<16sQQ")


@dataclass(frozen=True, slots=True)
class Attachment:
    boot_id: UUID  # new at each start of the server
    tick: int
    sequence: int


def pack_attachment(boot_id: UUID, tick: int, sequence: int) -> bytes:
    return _LAYOUT.pack(boot_id.bytes, tick, sequence)


def unpack_attachment(data: bytes) -> Attachment:
    """Raises: ValueError: the bytes are no attachment of ours."""
    if len(data) != _LAYOUT.size:
        raise ValueError(f"an attachment has {_LAYOUT.size} bytes, not {len(data)}")
    boot_id, tick, sequence = _LAYOUT.unpack(data)
    return Attachment(UUID(bytes=boot_id), tick, sequence)
