"""Runs a command in a network namespace without a way out, whose name server knows no name, and prints what was asked.

    unshare --net --mount --fork --kill-child python -m tests.support.name_server COMMAND…

The last line of the output is a JSON list of the names.
"""

import json
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

NAME_ERROR = b"\x81\x83"
"""Flags of a response: the name does not exist."""


def question(packet: bytes) -> tuple[str, bytes]:
    """Return the name of a query, and the bytes of its question (RFC 1035, section 4.1.2)."""
    labels, at = [], 12
    while length := packet[at]:
        labels.append(packet[at + 1 : at + 1 + length].decode())
        at += 1 + length
    return ".".join(labels), packet[12 : at + 5]


def answer(server: socket.socket, names: list[str]) -> None:
    while True:
        packet, client = server.recvfrom(2000)
        name, asked = question(packet)
        names.append(name)
        server.sendto(packet[:2] + NAME_ERROR + packet[4:6] + bytes(6) + asked, client)


def main() -> None:
    # A default route, without which libraries see that there is no network and ask nothing.
    for command in (
        "ip link set lo up",
        "ip link add out type veth peer name far",
        "ip address add 10.9.9.1/24 dev out",
        "ip link set out up",
        "ip route add default via 10.9.9.2",
    ):
        subprocess.run(command.split(), check=True)
    with tempfile.NamedTemporaryFile("w") as resolver:
        resolver.write("nameserver 127.0.0.1\n")
        resolver.flush()
        subprocess.run(["mount", "--bind", resolver.name, str(Path("/etc/resolv.conf").resolve())], check=True)
        server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        server.bind(("127.0.0.1", 53))
        names: list[str] = []
        threading.Thread(target=answer, args=(server, names), daemon=True).start()
        process = subprocess.run(sys.argv[1:], check=False)
        print(json.dumps(names))
    sys.exit(process.returncode)


if __name__ == "__main__":
    main()
