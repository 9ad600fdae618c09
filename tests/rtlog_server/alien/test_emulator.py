"""The emulated reader's own end: its consoles talk as the manual says."""

import os
import socket
from pathlib import Path

from rtlog_server.devices.alien.emulator import Alr9650Emulator


def talk(client: socket.socket, line: str) -> str:
    """Send a line to the console, read on to the NUL of its reply."""
    client.sendall(line.encode() + b"\r\n")
    return read_piece(client)


def read_piece(client: socket.socket) -> str:
    data = b""
    while not data.endswith(b"\0"):
        received = client.recv(1)
        assert received, data
        data += received
    return data.decode()


def test_the_emulators_console_talks_as_the_manual_says(emulator: Alr9650Emulator) -> None:
    with socket.create_connection(("127.0.0.1", emulator.port)) as client:
        greeting = read_piece(client)
        assert "* Alien Technology : RFID Reader" in greeting
        assert greeting.endswith("\r\nUsername>\0")
        assert talk(client, "Alien").endswith("Password>\0")  # the user name is case sensitive
        assert "Error: Invalid Username and/or Password" in talk(client, "password")
        assert talk(client, "alien").endswith("Password>\0")
        assert talk(client, "password").endswith("Alien>\0")
        assert talk(client, "\x01get ReaderName") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01GET readername") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01ReaderName?") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01") == "\r\n\0"
        assert talk(client, "\x01set AcqG2AntennaCombine = OFF") == "Error 1: Command not understood.\r\n\0"
        assert talk(client, "\x01set AutoMode = MAYBE") == "Error 4: Invalid use of command.\r\n\0"
        assert talk(client, "\x01set ReaderType = mine") == "Error 4: Invalid use of command.\r\n\0"
        assert talk(client, "\x01t") == "(No Tags)\r\n\0"
        assert talk(client, "\x01AutoMode=ON") == "AutoMode = ON\r\n\0"
        emulator.read_tag("1115F26881C3C012", count=4)
        assert talk(client, "\x01get TagList").startswith("Tag:1115 F268 81C3 C012, Disc:1970/01/01 00:00:0")
        assert talk(client, "get AutoMode") == "get AutoMode\r\nAutoMode = ON\r\n\0"  # with echo
        assert read_piece(client) == "\r\nAlien>\0"  # and prompt
        assert talk(client, "\x01Quit") == "Goodbye!\r\n\0"
        assert client.recv(1) == b""


def test_the_serial_console_asks_for_no_login(emulator: Alr9650Emulator, link: Path) -> None:
    port = os.open(link, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(port, b"\x01get readername\r\nget AutoMode\r\n")
        heard = b""
        while heard.count(b"\0") < 3:
            heard += os.read(port, 4096)
    finally:
        os.close(port)
    assert heard == b"ReaderName = Alien RFID Reader\r\n\0get AutoMode\r\nAutoMode = OFF\r\n\0\r\nAlien>\0"


def read_notification(server: socket.socket) -> str:
    connection, _ = server.accept()
    with connection:
        return read_piece(connection)


def test_a_notification_reads_as_in_the_manual(emulator: Alr9650Emulator) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        for command in (f"NotifyAddress = {address}", "NotifyTrigger = Add", "NotifyMode = ON", "AutoMode = ON"):
            assert emulator.configure(command) == command
        emulator.read_tag("11C400E32A39")
        message = read_notification(server)
    lines = message.split("\r\n")
    assert lines[:2] == ["#Alien RFID Reader Auto Notification Message", "#ReaderName: Alien RFID Reader"]
    assert "#Reason: TAGS ADDED" in lines
    assert lines[-3].startswith("Tag:11C4 00E3 2A39, Disc:1970/01/01 00:00:0")
    assert lines[-2:] == ["#End of Notification Message", "\0"]
