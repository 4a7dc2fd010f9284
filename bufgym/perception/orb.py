"""ORBBuf as its paper describes it [wang2021orbbuf]: the similarity of images decides which message to drop.

Similarity is the share of an image's ORB features that match a feature of the other image, each being the other's
nearest (Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011). The formula is ours, because the
released code has a random number in its place and the paper's wording was not at hand. The rest of the rule is the
policy `orbbuf`, which compares recorded motion.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bufgym.model.buffer import ACCEPT, Buffer, has_space
from bufgym.perception.extra import library
from bufgym.perception.frames import Image, Sequence
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.scenario import Episode

FEATURES: Final = 500
"""Most features of an image, OpenCV's default."""
NEAR_BITS: Final = 64
"""Most differing bits of matching 256-bit descriptors; ORB-SLAM2's TH_LOW is 50 and its TH_HIGH 100."""


class OrbSimilarity:
    """Similarity of the images of two frames; features are computed once a frame and pairs compared once."""

    def __init__(self, image: Callable[[int], Image], features: int = FEATURES) -> None:
        """``image(k)`` is the picture of frame k, uint8[height, width]."""
        cv2 = library("cv2")
        self._image = image
        self._detector = cv2.ORB_create(features)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._descriptors: dict[int, NDArray[np.uint8]] = {}
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, i: int, j: int) -> float:
        """Compare two frames, in either order, in [0, 1]; an image without features is like no other."""
        pair = (i, j) if i < j else (j, i)
        if pair not in self._known:
            first, second = self._of(pair[0]), self._of(pair[1])
            fewest, most = sorted((len(first), len(second)))
            near = sum(m.distance <= NEAR_BITS for m in self._matcher.match(first, second)) if fewest else 0
            self._known[pair] = near / max(most, 1)
        return self._known[pair]

    def _of(self, k: int) -> NDArray[np.uint8]:
        if k not in self._descriptors:
            _, found = self._detector.detectAndCompute(self._image(k), None)
            self._descriptors[k] = np.zeros((0, 32), np.uint8) if found is None else found
        return self._descriptors[k]


def orbbuf_by(similar: Callable[[int, int], float], episode: Episode, name: str = "orbbuf-images") -> Policy:
    """Make `orbbuf` for one episode from a similarity of two frames, given by their indices in the episode."""
    frames = {int(time_us): k for k, time_us in enumerate(episode.arrivals["arrival_us"].tolist())}

    def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
        L = len(buffer.slots)
        if has_space(buffer, arrival):
            return ACCEPT
        # The head's older neighbour is the last departed message; before any departure the head stays.
        queue = [frames[int(buffer.dequeued_arrival_us)], *(int(seq) for seq in buffer.slots["seq"])]
        victim, most_similar = L - 1, -np.inf
        for k in range(0 if buffer.dequeued > 0 and L > 2 else 1, L - 1):
            if (similarity := similar(queue[k], queue[k + 2])) > most_similar:
                victim, most_similar = k, similarity
        return victim

    about = "ORBBuf by what two images have in common; it sees the images, as no other policy does."
    return Policy(name, on_arrival, about=about, source="ORBBuf [wang2021orbbuf], ORB features by OpenCV")


def orbbuf_with_images(sequence: Sequence, episode: Episode) -> Policy:
    """Make `orbbuf` by the ORB features of the frames, which must be the episode's messages in order."""
    return orbbuf_by(OrbSimilarity(sequence.grey), episode)


COMPARED: Final = 3
"""Number of further images that the last decision compares."""


def decision_ms(sequence: Sequence, decisions: int = 50, features: int = FEATURES) -> NDArray[np.float64]:
    """Time single decisions as the paper describes them, float64[decisions], ms.

    After an eviction and an arrival, a decision computes the new image's features and the similarities of the gap's
    neighbours to their new neighbours. Reading the images is not timed.
    """
    images = [sequence.grey(k) for k in range(decisions + COMPARED)]
    similar = OrbSimilarity(images.__getitem__, features)
    for k in range(COMPARED - 1):
        similar(k, k + 1)
    times = np.zeros(decisions)
    for k in range(decisions):
        start_ns = time.perf_counter_ns()
        similar(k, k + 2)
        similar(k + 1, k + COMPARED)
        times[k] = (time.perf_counter_ns() - start_ns) / 1e6
    return times
