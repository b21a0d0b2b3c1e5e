"""What stands for the network card: a socket to the controller, and faults that can be put in between.

Each packet, either way, is lost with a probability; what is not lost is held back for a constant delay and a
random one, so that packets overtake one another. All draws come from one seed.
"""

import heapq
import select
import socket
import time
from array import array
from collections.abc import Callable
from random import Random
from typing import NamedTuple

LONGEST_PACKET = 512


class Injection(NamedTuple):
    """Faults put into the network, of each packet and each way."""

    drops: float = 0.0  # probability of a loss
    jitter: float = 0.0  # width of a delay drawn uniformly from 0 on [s]
    delay: float = 0.0  # constant delay [s]

    @property
    def any(self) -> bool:
        """Whether there are any faults."""
        return self.drops > 0.0 or self.jitter > 0.0 or self.delay > 0.0


class Network:
    """Packets to one address and back. Times are those of `time.monotonic_ns`. `number_of(answer)` is the
    number of the packet that bytes from there answer, None if they answer none.

    `lost` and `held_back` say by the packet's number what was injected: 1 where the packet or its answer was
    lost; the time for which both together were held back [ns].
    """

    def __init__(
        self,
        address: tuple[str, int],
        injection: Injection,
        seed: int,
        packets: int,
        number_of: Callable[[bytes], int | None],
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(address)
        self._socket.setblocking(False)
        self._injection, self._any, self._random = injection, injection.any, Random(seed)
        self._going: list[tuple[int, int, bytes]] = []
        self._coming: list[tuple[int, int, bytes]] = []
        self._count, self._number_of = 0, number_of
        self.lost = array("b", bytes(packets))
        self.held_back = array("q", bytes(8 * packets))

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def send(self, number: int, packet: bytes) -> None:
        """Send packet `number`, or let happen to it what the injection says."""
        held = self._fate(number)
        if held is None:
            return
        if held <= 0:
            self.send_plainly(packet)
        else:
            self._count += 1
            heapq.heappush(self._going, (time.monotonic_ns() + held, self._count, packet))

    def send_plainly(self, packet: bytes) -> None:
        """Send a packet past all injection."""
        try:
            self._socket.send(packet)
        except OSError:
            # Nobody listens: the tick will be a missed one.
            pass

    def ask(self, packet: bytes, wait: float) -> bytes | None:
        """What comes back within `wait` [s] after a packet, past all injection; None if nothing does."""
        self.send_plainly(packet)
        if not select.select([self._socket], [], [], wait)[0]:
            return None
        try:
            return self._socket.recv(LONGEST_PACKET)
        except OSError:
            return None

    def receive(self) -> list[tuple[int, bytes]]:
        """What has arrived by now: when [ns], and the packet."""
        self._drain()
        now, ready = time.monotonic_ns(), []
        while self._coming and self._coming[0][0] <= now:
            arrived, _, packet = heapq.heappop(self._coming)
            ready.append((arrived, packet))
        return ready

    def wait(self, until: int, for_arrivals: bool = True) -> None:
        """Wait until something may have arrived, at the longest until `until` [ns]; send what is due."""
        now = time.monotonic_ns()
        while self._going and self._going[0][0] <= now:
            self.send_plainly(heapq.heappop(self._going)[2])
        if self._going:
            until = min(until, self._going[0][0])
        if self._coming and for_arrivals:
            until = min(until, self._coming[0][0])
        if until > now and select.select([self._socket], [], [], (until - now) * 1e-9)[0]:
            self._drain()

    def _drain(self) -> None:
        """Take over what the socket has, to be received once it has been held back."""
        while True:
            try:
                packet = self._socket.recv(LONGEST_PACKET)
            except OSError:
                # Nothing there, or nobody listens (yet).
                return
            held: int | None = 0
            if self._any:
                number = self._number_of(packet)
                held = None if number is None else self._fate(number)
            if held is not None:
                self._count += 1
                heapq.heappush(self._coming, (time.monotonic_ns() + held, self._count, packet))

    def _fate(self, number: int) -> int | None:
        """For how long a packet is held back [ns], or None for one that is lost."""
        if not self._any:
            return 0
        drops, jitter, delay = self._injection
        known = 0 <= number < len(self.lost)
        if self._random.random() < drops:
            if known:
                self.lost[number] = 1
            return None
        held = round(1e9 * (delay + jitter * self._random.random()))
        if known:
            self.held_back[number] += held
        return held
