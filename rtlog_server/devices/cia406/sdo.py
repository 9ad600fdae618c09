"""SDO transfers: reading and writing a node's objects, over canopen's client, without a thread of its own.

In: object addresses (index, sub-index) and numbers. Out: numbers and texts. canopen knows the transfers, expedited and
segmented; its own way of receiving, a notifier thread with queues that nothing bounds, is put aside: whoever opens
the client gives it `await_reply`, which goes on serving the bus until the reply is in.
"""

import logging
import time
from collections.abc import Callable
from typing import TypeVar

import canopen
from canopen.sdo.client import SdoClient

from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.protocol import CanOpenError, Frame

TRANSFER_TIMEOUT_S = 0.3  # for the whole of it, so that endless segments cost bounded memory
ABORTED = 0x80  # command specifier

T = TypeVar("T")
Address = tuple[int, int]  # index, sub-index
Send = Callable[[Frame], object]
AwaitReply = Callable[[int, int], bytes | None]  # node, deadline (monotonic ns): the 8 bytes, or None

logging.getLogger("canopen").setLevel(logging.CRITICAL)  # it logs each failure that it raises as well


class NodeSilentError(CanOpenError):
    """The node did not answer in time, or with something that is no answer."""


class ObjectRefusedError(CanOpenError):
    """The node has no such object, or does not take the value."""


class NodeObjects:
    """The objects of one node. Raises, in all its methods: NodeSilentError, ObjectRefusedError, DeviceError."""

    def __init__(self, node: int, send: Send, await_reply: AwaitReply) -> None:
        self._client = _Client(node, send, await_reply)

    def read(self, address: Address) -> int:
        """An unsigned number of 1 to 4 bytes."""
        data = self._transfer(address, lambda: self._client.upload(*address))
        if not 1 <= len(data) <= 4:
            raise NodeSilentError(f"object {name(address)} has {len(data)} bytes, no number")
        return int.from_bytes(data, "little")

    def read_text(self, address: Address) -> str:
        """What of a text can be printed."""
        data = self._transfer(address, lambda: self._client.upload(*address))
        return "".join(letter for letter in data.decode("ascii", "replace") if letter.isprintable()).strip()

    def write(self, address: Address, number: int, size: int) -> None:
        """A number of `size` bytes."""
        self._transfer(address, lambda: self._client.download(*address, number.to_bytes(size, "little")))

    def _transfer(self, address: Address, transfer: Callable[[], T]) -> T:
        self._client.deadline_ns = time.monotonic_ns() + int(TRANSFER_TIMEOUT_S * 1e9)
        try:
            return transfer()
        except canopen.SdoAbortedError as error:
            raise ObjectRefusedError(f"object {name(address)}: {error}") from error
        except canopen.SdoCommunicationError as error:
            raise NodeSilentError(f"{error} (object {name(address)})") from error


def name(address: Address) -> str:
    """As manuals write it: 1800h:2."""
    return f"{address[0]:04X}h:{address[1]}"


class _Client(SdoClient):
    """canopen's client at our bus."""

    def __init__(self, node: int, send: Send, await_reply: AwaitReply) -> None:
        super().__init__(protocol.SDO_REQUEST + node, protocol.SDO_REPLY + node, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]
        self._node, self._send, self._await_reply = node, send, await_reply
        self.deadline_ns = 0

    def send_request(self, request: bytes) -> None:
        self._send(Frame(self.rx_cobid, bytes(request)))

    def read_response(self) -> bytes:
        response = self._await_reply(self._node, self.deadline_ns)
        if response is None:
            raise canopen.SdoCommunicationError("no answer")
        if response[0] == ABORTED:
            raise canopen.SdoAbortedError(int.from_bytes(response[4:8], "little"))
        return response
