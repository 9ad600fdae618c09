"""SDO transfers against answers as a node gives them, byte for byte, and as none should."""

import itertools
import time
from collections.abc import Iterable

import pytest

from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.cia406.sdo import NodeObjects, NodeSilentError, ObjectRefusedError, name


class Script:
    """Gives one answer after the other, until the deadline; keeps the requests."""

    def __init__(self, answers: Iterable[str]) -> None:
        self._answers = iter(answers)
        self.requests: list[Frame] = []
        self.objects = NodeObjects(5, self.requests.append, self._await_reply)

    def _await_reply(self, node: int, deadline_ns: int) -> bytes | None:
        assert node == 5
        answer = next(self._answers, None)
        return bytes.fromhex(answer) if answer and time.monotonic_ns() < deadline_ns else None


def test_numbers_are_read_in_one_exchange() -> None:
    script = Script(["43 00 10 00 96 01 02 00", "4B 17 10 00 C8 00 00 00"])
    assert script.objects.read((0x1000, 0)) == 0x0002_0196
    assert script.objects.read((0x1017, 0)) == 200
    assert script.requests[0] == Frame(0x605, bytes.fromhex("40 00 10 00 00 00 00 00"))


def test_a_number_is_written_in_one_exchange() -> None:
    script = Script(["60 17 10 00 00 00 00 00"])
    script.objects.write((0x1017, 0), 200, 2)
    assert script.requests == [Frame(0x605, bytes.fromhex("2B 17 10 00 C8 00 00 00"))]


def test_a_text_is_read_in_segments_and_what_cannot_be_printed_left_out() -> None:
    script = Script(["41 08 10 00 0A 00 00 00", "00 45 4E 0A 43 4F 44 45", "19 52 20 00 00 00 00 00"])
    assert script.objects.read_text((0x1008, 0)) == "ENCODER"
    assert [request.data[0] for request in script.requests] == [0x40, 0x60, 0x70]


def test_a_refusal_is_told_with_its_reason() -> None:
    script = Script(["80 01 60 00 02 00 01 06"])
    with pytest.raises(ObjectRefusedError, match=r"object 6001h:0: .*write a read only object"):
        script.objects.write((0x6001, 0), 1000, 4)


def test_a_silent_node_is_told_so_and_the_transfer_ended() -> None:
    script = Script([])
    with pytest.raises(NodeSilentError, match=r"no answer \(object 1018h:4\)"):
        script.objects.read((0x1018, 4))
    assert script.requests[-1].data == bytes.fromhex("80 00 00 00 00 00 04 05")  # abort: time-out


def test_an_answer_for_another_object_is_none() -> None:
    with pytest.raises(NodeSilentError, match=r"0x6002"):
        Script(["43 02 60 00 00 10 00 00"]).objects.read((0x6001, 0))


def test_a_number_of_many_bytes_is_none() -> None:
    script = Script(["41 00 10 00 08 00 00 00", "00 31 32 33 34 35 36 37", "1D 38 00 00 00 00 00 00"])
    with pytest.raises(NodeSilentError, match=r"object 1000h:0 has 8 bytes, no number"):
        script.objects.read((0x1000, 0))


def test_segments_without_an_end_are_cut_off() -> None:
    endless = itertools.chain(["41 08 10 00 FF FF FF FF"], itertools.cycle(["00" + "41" * 7, "10" + "41" * 7]))
    with pytest.raises(NodeSilentError):
        Script(endless).objects.read_text((0x1008, 0))


def test_objects_are_named_as_manuals_do() -> None:
    assert name((0x1800, 2)) == "1800h:2"
