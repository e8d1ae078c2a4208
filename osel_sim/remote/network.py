"""How long messages take, on a virtual clock: drawn from a seed, never measured.

The same (seed, call) gives the same delays on any machine, so that a journal can be reproduced. Each call draws a fixed number of random numbers in a
fixed order, so two profiles with one seed meet the same luck and differ by what they are.
"""

import math
from dataclasses import dataclass

import numpy as np

from osel_sim.core.errors import UnknownNameError
from osel_sim.formats.policy_file import NETWORKS

MINIMUM_RETRANSMISSION = 0.2  # seconds added to the round trip before TCP sends again (Linux' TCP_RTO_MIN; RFC 6298 has 1 s)
MAX_LOSSES = 6  # of one message in a row
INFERENCE_SIGMA = 0.05  # a few percent of spread around the declared inference time


@dataclass(frozen=True)
class NetworkProfile:
    """One kind of link between robot and server.

    Attributes:
        uplink, downlink: megabits per second, robot to server and back.
        round_trip: seconds, without payload, on a good moment.
        jitter: median of what queues and radio add to a round trip, seconds. Lognormal: measured delays have a long right tail that a gamma or normal
            law
            misses (median 3, 90th percentile 20, 99th 250 ms on one Wi-Fi hop: Sui et al. 2016; a lognormal through the first two has its 99th at
            94).
        jitter_sigma: standard deviation of the logarithm of the jitter.
        loss: probability that a message (not a packet: most lost packets are repaired quickly) waits for TCP's retransmission timeout, doubling each
            time.
        outage: probability that the link is gone when a call begins.
        outage_seconds: mean of how long it stays so; exponential.
    """

    uplink: float
    downlink: float
    round_trip: float
    jitter: float = 0.0
    jitter_sigma: float = 0.0
    loss: float = 0.0
    outage: float = 0.0
    outage_seconds: float = 0.0

    def __post_init__(self) -> None:
        if not (self.uplink > 0 and self.downlink > 0):
            raise ValueError("bandwidth must be positive")
        if not (0 <= self.loss < 1 and 0 <= self.outage < 1):
            raise ValueError("probabilities must lie in [0, 1)")
        if not all(0 <= value < math.inf for value in (self.round_trip, self.jitter, self.jitter_sigma, self.outage_seconds)):
            raise ValueError("seconds and spread must be finite and not negative")


# Bandwidth, round trip and jitter follow the published measurements named here, rounded. How often messages are lost and links are gone depends so
# much on the place that loss and outage are our assumptions, in the order that everyday experience has them.
PROFILES = {
    # The policy server is on the robot.
    "none": NetworkProfile(math.inf, math.inf, 0.0),
    # Gigabit cable to a server in the same building or data centre. Guo et al., Pingmesh (SIGCOMM 2015): round trips of 0.2 to 0.3 ms, 99th
    # percentile above 1 ms.
    "ethernet": NetworkProfile(940.0, 940.0, 0.0005, jitter=0.0001, jitter_sigma=1.0, loss=0.0001),
    # Wi-Fi, then a good wired line to a data centre of the region (20 ms). Sui et al., Characterizing and Improving WiFi Latency (MobiSys 2016):
    # median 3, 90th percentile 20 ms a hop, hence sigma = ln(20 / 3) / 1.28. Rates of an ordinary home or office line, asymmetric as these are.
    "wifi": NetworkProfile(20.0, 80.0, 0.020, jitter=0.003, jitter_sigma=1.48, loss=0.005, outage=0.0005, outage_seconds=2.0),
    # Huang et al., A Close Examination of Performance and Power Characteristics of 4G LTE Networks (MobiSys 2012): median 13 Mbit/s down, 6 up, 70 ms
    # round trip.
    "lte": NetworkProfile(6.0, 13.0, 0.060, jitter=0.010, jitter_sigma=1.0, loss=0.01, outage=0.003, outage_seconds=3.0),
    # Geostationary. Michel et al., A First Look at Starlink Performance (IMC 2022): its SatCom line is sold as 100/10 Mbit/s and reaches less than
    # that; latency from 600 ms on, of which 480 are the way of light (4 x 35,786 km).
    "satellite": NetworkProfile(5.0, 80.0, 0.600, jitter=0.030, jitter_sigma=0.8, loss=0.01, outage=0.005, outage_seconds=5.0),
}


def profile(name: str) -> NetworkProfile:
    """A named profile.

    Raises:
        UnknownNameError: with the nearest known name.
    """
    if name not in PROFILES:
        raise UnknownNameError("network", name, NETWORKS)
    return PROFILES[name]


@dataclass(frozen=True)
class Delays:
    """Seconds on the virtual clock of one call. `outage` is the part of `upload` spent without a link."""

    upload: float
    inference: float
    download: float
    outage: float = 0.0

    @property
    def total(self) -> float:
        """Upload + inference + download."""
        return self.upload + self.inference + self.download


class NetworkModel:
    """Draws the delays of one episode's calls, one after the other.

    Args:
        profile: the link.
        seed: integers >= 0 that name the episode, such as (instance, policy, repeat).
    """

    def __init__(self, profile: NetworkProfile, seed: tuple[int, ...]) -> None:
        self._profile, self._calls = profile, 0
        self._seed = (len(seed), *seed)  # its length, because numpy takes (1,) and (1, 0) for the same entropy

    def delays(self, bytes_up: int, inference_seconds: float, bytes_down: int) -> Delays:
        """Delays of the next call.

        Args:
            bytes_up, bytes_down: length of the frames.
            inference_seconds: declared time of one inference, the median of what is drawn.
        """
        link = self._profile
        random = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(self._calls,)))
        self._calls += 1
        jitter_up, jitter_down, jitter_inference = random.standard_normal(3)
        loss_up, loss_down, no_link = random.random(3)
        outage = random.exponential() * link.outage_seconds
        outage = outage if no_link < link.outage else 0.0
        upload = outage + _transfer(link, bytes_up, link.uplink, jitter_up, loss_up)
        download = _transfer(link, bytes_down, link.downlink, jitter_down, loss_down)
        inference = inference_seconds * math.exp(INFERENCE_SIGMA * jitter_inference)
        # Rounded to microseconds, since the last bit of exp and log differs between C libraries.
        return Delays(*(round(seconds, 6) for seconds in (upload, inference, download, outage)))


def _transfer(link: NetworkProfile, size: int, megabits: float, normal: float, uniform: float) -> float:
    """Seconds one message takes one way: half a round trip, its bits, jitter, and retransmissions."""
    jitter = 0.5 * link.jitter * math.exp(link.jitter_sigma * normal)
    # P(n losses or more) = loss^n, hence n = floor(ln u / ln loss).
    losses = min(MAX_LOSSES, int(math.log(max(uniform, 1e-300)) / math.log(link.loss))) if link.loss > 0 else 0
    waiting = (link.round_trip + MINIMUM_RETRANSMISSION) * ((1 << losses) - 1)
    return 0.5 * link.round_trip + 8e-6 * size / megabits + jitter + waiting
