"""Simulated network card: a socket to the controller's process, with injected faults.

Packets in both directions are lost with a given probability. All other packets are delayed by the sum of a
constant and a random time, so that a packet may overtake an earlier one. All random numbers follow from one
seed.
"""

import heapq
import select
import socket
import time
from array import array
from collections.abc import Callable
from random import Random
from typing import NamedTuple

MAX_PACKET_BYTES = 1024  # size of the receive buffer, larger than any packet of `udp_protocol`


class Injection(NamedTuple):
    """Network faults that are injected into every packet in both directions."""

    drops: float = 0.0  # probability that a packet is lost [1]
    jitter: float = 0.0  # largest random delay [s]; the random delay is uniform from 0 to this value
    delay: float = 0.0  # constant delay [s]

    @property
    def any(self) -> bool:
        """Return whether any fault is injected."""
        return self.drops > 0.0 or self.jitter > 0.0 or self.delay > 0.0


class Network:
    """UDP connection to one address, with injected faults; the clock is `time.monotonic_ns`.

    The function `number_of` decodes received bytes. It returns the number of the packet that they answer, or
    None if they are not an answer.

    Attributes:
        lost: 1 if injection lost the packet or its answer, else 0, (packets,).
        injected_delay: total injected delay of the packet and its answer [ns], (packets,).
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
        self._injection, self._has_faults, self._random = injection, injection.any, Random(seed)
        self._outgoing: list[tuple[int, int, bytes]] = []
        self._incoming: list[tuple[int, int, bytes]] = []
        self._count, self._number_of = 0, number_of
        self.lost = array("b", bytes(packets))
        self.injected_delay = array("q", bytes(8 * packets))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, number: int, packet: bytes) -> None:
        """Send packet `number`; injection may lose the packet, or delay it until `wait` sends it."""
        delay = self._draw_delay(number)
        if delay is None:
            return
        if delay <= 0:
            self.send_without_faults(packet)
        else:
            self._count += 1
            heapq.heappush(self._outgoing, (time.monotonic_ns() + delay, self._count, packet))

    def send_without_faults(self, packet: bytes) -> None:
        """Send a packet at once, without injected loss or delay."""
        try:
            self._socket.send(packet)
        except OSError:
            # No process listens; the tick will count as missed.
            pass

    def ask(self, packet: bytes, wait: float) -> bytes | None:
        """Send a packet without injected faults; return the answer, or None after `wait` [s]."""
        self.send_without_faults(packet)
        if not select.select([self._socket], [], [], wait)[0]:
            return None
        try:
            return self._socket.recv(MAX_PACKET_BYTES)
        except OSError:
            return None

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the packets that have arrived since the last call, each with its arrival time [ns]."""
        self._drain()
        now, ready = time.monotonic_ns(), []
        while self._incoming and self._incoming[0][0] <= now:
            arrived, _, packet = heapq.heappop(self._incoming)
            ready.append((arrived, packet))
        return ready

    def wait(self, until: int, for_arrivals: bool = True) -> None:
        """Send the delayed packets that are due, then wait for a packet, at most until the time `until` [ns].

        With `for_arrivals`, the wait also ends when the injected delay of a received packet ends.
        """
        now = time.monotonic_ns()
        while self._outgoing and self._outgoing[0][0] <= now:
            self.send_without_faults(heapq.heappop(self._outgoing)[2])
        if self._outgoing:
            until = min(until, self._outgoing[0][0])
        if self._incoming and for_arrivals:
            until = min(until, self._incoming[0][0])
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
            if self._has_faults:
                number = self._number_of(packet)
                delay = None if number is None else self._draw_delay(number)
            if delay is not None:
                self._count += 1
                heapq.heappush(self._incoming, (time.monotonic_ns() + delay, self._count, packet))

    def _draw_delay(self, number: int) -> int | None:
        """Draw and record the injected delay [ns] of packet `number`; return None if the packet is lost."""
        if not self._has_faults:
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
