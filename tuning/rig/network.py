"""Simulated network card: a socket to the controller, with injected faults.

Each packet in either direction is lost with a probability; other packets are delayed by a constant and a
random time, so that they may overtake one another. All draws come from one seed.
"""

import heapq
import select
import socket
import time
from array import array
from collections.abc import Callable
from random import Random
from typing import NamedTuple

MAX_PACKET_BYTES = 512


class Injection(NamedTuple):
    """Faults injected into the network, per packet and direction."""

    drops: float = 0.0  # probability of a loss [1]
    jitter: float = 0.0  # upper end of a uniformly distributed delay from 0 [s]
    delay: float = 0.0  # constant delay [s]

    @property
    def any(self) -> bool:
        """Return whether there are any faults."""
        return self.drops > 0.0 or self.jitter > 0.0 or self.delay > 0.0


class Network:
    """Connection to one address with injected faults; times are those of `time.monotonic_ns`.

    `number_of(answer)` returns the number of the packet that an answer belongs to, None if to none. The
    injected faults are stored by packet number: `lost` is 1 if the packet or its answer was lost, `held_back`
    is the total delay of both [ns].
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
        self.injected_delay = array("q", bytes(8 * packets))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, number: int, packet: bytes) -> None:
        """Send packet `number` with the injected faults."""
        delay = self._draw_delay(number)
        if delay is None:
            return
        if delay <= 0:
            self.send_plainly(packet)
        else:
            self._count += 1
            heapq.heappush(self._going, (time.monotonic_ns() + delay, self._count, packet))

    def send_plainly(self, packet: bytes) -> None:
        """Send a packet without injected faults."""
        try:
            self._socket.send(packet)
        except OSError:
            # No process listens, so that the tick will be missed.
            pass

    def ask(self, packet: bytes, wait: float) -> bytes | None:
        """Send a packet without faults; return the answer within `wait` [s], None if there is none."""
        self.send_plainly(packet)
        if not select.select([self._socket], [], [], wait)[0]:
            return None
        try:
            return self._socket.recv(MAX_PACKET_BYTES)
        except OSError:
            return None

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the packets that have arrived by now, each with its time of arrival [ns]."""
        self._drain()
        now, ready = time.monotonic_ns(), []
        while self._coming and self._coming[0][0] <= now:
            arrived, _, packet = heapq.heappop(self._coming)
            ready.append((arrived, packet))
        return ready

    def wait(self, until: int, for_arrivals: bool = True) -> None:
        """Wait until a packet may have arrived, at most until `until` [ns]; send due delayed packets."""
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
        """Read all packets from the socket and queue them with their injected delays."""
        while True:
            try:
                packet = self._socket.recv(MAX_PACKET_BYTES)
            except OSError:
                # There is no further packet, or no process listens yet.
                return
            delay: int | None = 0
            if self._any:
                number = self._number_of(packet)
                delay = None if number is None else self._draw_delay(number)
            if delay is not None:
                self._count += 1
                heapq.heappush(self._coming, (time.monotonic_ns() + delay, self._count, packet))

    def _draw_delay(self, number: int) -> int | None:
        """Draw and record the delay [ns] of a packet; return None if it is lost."""
        if not self._any:
            return 0
        drops, jitter, constant = self._injection
        in_range = 0 <= number < len(self.lost)
        if self._random.random() < drops:
            if in_range:
                self.lost[number] = 1
            return None
        delay = round(1e9 * (constant + jitter * self._random.random()))
        if in_range:
            self.injected_delay[number] += delay
        return delay
