"""The attachment's layout, byte by byte, and its way back."""

from uuid import UUID

import pytest

from rtlog_server.attachment import Attachment, pack_attachment, unpack_attachment

BOOT = UUID("00112233-4455-6677-8899-aabbccddeeff")


def test_layout_is_the_contract() -> None:
    data = pack_attachment(BOOT, 0x0102030405060708, 9)
    assert data.hex() == "00112233445566778899aabbccddeeff" + "0807060504030201" + "0900000000000000"


def test_what_goes_in_comes_out() -> None:
    for tick, sequence in [(0, 0), (1, 2**64 - 1), (2**64 - 1, 7)]:
        assert unpack_attachment(pack_attachment(BOOT, tick, sequence)) == Attachment(BOOT, tick, sequence)


@pytest.mark.parametrize("size", [0, 31, 33])
def test_other_lengths_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"not {size}"):
        unpack_attachment(bytes(size))
