"""The outbox on a real pipe: bounded, never waiting, in order, counted."""

import multiprocessing

from patience import PATIENCE_S

from rtlog_server.outbox import Outbox


def test_put_never_waits_and_counts_what_finds_it_full() -> None:
    reader, writer = multiprocessing.Pipe()
    outbox = Outbox(writer, capacity=5)
    outbox.start()
    # nobody reads yet: a put that waited would wait for ever
    accepted = [number for number in range(200) if outbox.put((number, bytes(50_000)))]
    assert outbox.dropped == 200 - len(accepted) > 150
    # the reader wakes up: what was accepted is all there, in order
    received = [reader.recv()[0] for _ in accepted]
    assert received == accepted
    assert outbox.put((200, b""))
    assert outbox.close(timeout_s=PATIENCE_S)
    assert reader.recv()[0] == 200
    try:
        reader.recv()
    except EOFError:
        return
    raise AssertionError("the pipe did not end")


def test_a_reader_that_takes_nothing_ends_the_wait_for_it() -> None:
    _reader, writer = multiprocessing.Pipe()
    outbox = Outbox(writer, capacity=5)
    outbox.start()
    for _ in range(4):
        outbox.put(bytes(1_000_000))
    assert not outbox.close(timeout_s=0.1)  # and not for ever
    _reader.close()  # so that the sender's thread can end


def test_a_reader_that_is_gone_is_no_error_here() -> None:
    reader, writer = multiprocessing.Pipe()
    reader.close()
    outbox = Outbox(writer, capacity=5)
    outbox.start()
    for number in range(3):
        outbox.put(number)
    assert not outbox.close(timeout_s=PATIENCE_S)
