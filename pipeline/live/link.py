"""A connection that speaks lines: a request, an answer; torn ones are made anew and the request is asked again.

Every request may be asked twice: moves are absolute, and an answer counts only when its last line has come whole.
"""

import math
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from robcal.errors import InvalidInput, RobcalError

LONGEST = 1_000_000
"""Bytes of an answer without an end of line after which it is none."""


class NoAnswer(RobcalError):
    """The other side cannot be reached, or answers nothing."""


@dataclass(frozen=True)
class Pace:
    """How long to wait for what, in seconds.

    Attributes
    ----------
    answer : for a line. again : before connecting anew, doubled each time. tries : connections without any answer.
    poll : between two readings of the joints. still : over which they have to stand. move : for a whole move.
    """

    answer: float = 30.0
    again: float = 0.5
    tries: int = 6
    poll: float = 0.1
    still: float = 0.5
    move: float = 180.0


def address_of(text: str, what: str) -> tuple[str, int]:
    """Host and port of `HOST:PORT`.

    Raises
    ------
    InvalidInput : it is something else.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InvalidInput(f"--{what} is HOST:PORT, as 192.168.0.10:7000, not '{text}'")
    return host.strip("[]"), int(port)


@dataclass
class Link:
    """A connection to a controller or a sensor, opened when it is needed."""

    host: str
    port: int
    pace: Pace = field(default_factory=Pace)
    _socket: socket.socket | None = field(default=None, repr=False)
    _rest: bytes = field(default=b"", repr=False)

    def ask(self, request: str, answer: str) -> list[list[str]]:
        """Words of the lines that answer a request; ``answer`` is the first word that is waited for.

        An answer `POINTS name n` is followed by n lines, all others are one line.

        Raises
        ------
        NoAnswer : no connection, or torn too often. InvalidInput : the other side refuses or speaks another language.
        """
        wait = self.pace.again
        for attempt in range(self.pace.tries):
            if attempt:
                time.sleep(wait)
                wait *= 2
            try:
                return self._once(request, answer)
            except OSError as error:
                self.close()
                last = error
        raise NoAnswer(f"{self.host}:{self.port}: no answer to '{request.split()[0]}' ({last})")

    def close(self) -> None:
        """End the connection; the next request opens another one."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._rest = None, b""

    def _once(self, request: str, answer: str) -> list[list[str]]:
        if self._socket is None:
            self._socket = socket.create_connection((self.host, self.port), timeout=self.pace.answer)
            self._socket.sendall(b"HELLO robcal 1\n")
            self._read("HELLO")
        self._socket.sendall(f"{request}\n".encode())
        lines = [self._read(answer)]
        if lines[0][0] == "POINTS":
            count = lines[0][2] if len(lines[0]) == 3 else ""
            if not count.isdigit():
                raise InvalidInput(f"{self.host}:{self.port}: 'POINTS name n' was expected, not '{' '.join(lines[0])}'")
            lines += [self._read("POINT") for _ in range(int(count))]
        return lines

    def _read(self, expected: str) -> list[str]:
        """Words of the next whole line; what came before the connection was torn does not count."""
        if self._socket is None:
            raise OSError("not connected")
        while b"\n" not in self._rest:
            block = self._socket.recv(65536)
            if not block:
                raise OSError("the connection was torn")
            self._rest += block
            if len(self._rest) > LONGEST:
                raise InvalidInput(f"{self.host}:{self.port}: sends no lines: is it the right port?")
        line, self._rest = self._rest.split(b"\n", 1)
        words = line.decode("utf-8", "replace").split()
        if words and words[0] == "ERR":
            raise InvalidInput(f"{self.host}:{self.port}: says: {' '.join(words[1:]) or 'no reason'}")
        if not words or words[0] not in expected.split("|"):
            shown = " ".join(words)[:60]
            raise InvalidInput(f"{self.host}:{self.port}: answers '{shown}' where '{expected}' was expected")
        return words


def numbers(words: Sequence[str], count: int, where: str) -> list[float]:
    """So many finite numbers.

    Raises
    ------
    InvalidInput : other ones.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(v) for v in values):
        raise InvalidInput(f"{where}: {count} numbers were expected, not '{' '.join(words)[:80]}'")
    return values
