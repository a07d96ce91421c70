# SPDX-License-Identifier: Apache-2.0
"""Serve the twin's arm over TCP, as an arm's own program would: a sender to copy from.

python examples/arm_sender.py --port 4712 &
python -c "from armscan.devices import open_device; arm = open_device('arm', \
'tcp:127.0.0.1:4712'); arm.start(); print(arm.read(1.0)[0])"
"""

from __future__ import annotations

import argparse
import socket

from armscan.devices import open_device
from armscan.drivers.arm_stream import encode_sample


def serve(server: socket.socket, address: str, n_samples: int | None = None) -> None:
    """Send all samples of an arm to one program after the other; all of them if no number."""
    arm, lasers = open_device("arm", address), open_device("lasers", address)
    arm.start()
    lasers.start(20.0)
    try:
        while n_samples is None or n_samples > 0:
            client, _ = server.accept()
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                try:
                    while n_samples is None or n_samples > 0:
                        samples = arm.read(0.1)
                        client.sendall(b"".join(encode_sample(one) for one in samples))
                        n_samples = None if n_samples is None else n_samples - len(samples)
                except OSError:
                    continue
    finally:
        lasers.close()
        arm.close()


def main() -> None:
    """Read the options and serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description="Serve the twin's arm over TCP.")
    parser.add_argument("--port", type=int, default=4712)
    parser.add_argument("--arm", default="twin:thesis-single?scene=plate&loop=1")
    given = parser.parse_args()
    with socket.create_server(("127.0.0.1", given.port)) as server:
        print(f"tcp:127.0.0.1:{server.getsockname()[1]}", flush=True)
        serve(server, given.arm)


if __name__ == "__main__":
    main()
