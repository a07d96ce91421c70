# SPDX-License-Identifier: Apache-2.0
"""A laser controller of the documented protocol behind a pseudo-terminal, as firmware would be."""

from __future__ import annotations

import binascii
import os
import select
import threading
import time
import tty

WATCHDOG_S = 1.0


class ReferenceController(threading.Thread):
    """Answers as the page says; ``spoils`` so many lines each way, ``is_mute`` answers nothing."""

    def __init__(self, sources: str = "A+B") -> None:
        super().__init__(daemon=True)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.address = f"laser-serial:{os.ttyname(self.slave)}:115200"
        self.sources = sources
        self.schedule: list[str] = ["-"]
        self.period_s: float | None = None
        self.is_on = False
        self.n_triggers = 0
        self.n_steps = 0
        self.spoils_out = 0
        self.spoils_in = 0
        self.is_mute = False
        self.commands: list[str] = []
        self._wanted = True
        self.start()

    def end(self) -> None:
        self._wanted = False
        self.join()
        os.close(self.master)
        os.close(self.slave)

    def say(self, text: str) -> None:
        checksum = binascii.crc_hqx(text.encode(), 0xFFFF)
        line = f"{text}*{checksum:04X}\r\n".encode()
        if self.spoils_out:
            self.spoils_out -= 1
            line = bytes([line[0], line[1] ^ 4]) + line[2:]
        if not self.is_mute:
            os.write(self.master, line)

    def run(self) -> None:
        held, heard, due = b"", time.monotonic(), 0.0
        while self._wanted:
            wait = 0.02 if self.period_s is None else min(0.02, max(due - time.monotonic(), 0.0))
            if select.select([self.master], [], [], wait)[0]:
                held += os.read(self.master, 1000)
                *lines, held = held.split(b"\n")
                for line in lines:
                    if self.obey(line):
                        heard = time.monotonic()
                if not self.is_on:
                    due = time.monotonic()
            now = time.monotonic()
            if self.is_on and now - heard > WATCHDOG_S:
                self.is_on, self.period_s = False, None
                self.say("OFF WATCHDOG")
            if self.is_on and self.period_s is not None and now >= due:
                due = max(due, now - self.period_s) + self.period_s
                self.trigger()

    def trigger(self) -> None:
        self.n_triggers += 1
        on = self.schedule[self.n_steps % len(self.schedule)]
        self.n_steps += 1
        self.say(f"EV {self.n_triggers} {time.monotonic_ns() + 10**12} {on}")

    def obey(self, line: bytes) -> bool:
        if self.spoils_in:
            self.spoils_in -= 1
            return False
        content, _, checksum = line.rstrip(b"\r").rpartition(b"*")
        if checksum != b"%04X" % binascii.crc_hqx(content, 0xFFFF):
            return False
        number, command, *rest = content.decode().split(" ")
        self.commands.append(" ".join((command, *rest)))
        if command == "HELLO":
            self.say(f"{number} OK 1 {self.sources}")
        elif command == "SCHED":
            self.schedule, self.n_steps = rest[0].split(";"), 0
            self.say(f"{number} OK")
        elif command == "START":
            self.period_s = None if rest[0] == "EXT" else 1000.0 / int(rest[0])
            self.is_on = True
            self.say(f"{number} OK")
        elif command == "STOP":
            self.is_on, self.period_s = False, None
            self.say(f"{number} OK")
        elif command == "PING":
            self.say(f"{number} OK")
        else:
            self.say(f"{number} ERR unknown")
        return True
