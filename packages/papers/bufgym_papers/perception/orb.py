"""ORBBuf as its paper describes it [wang2021orbbuf]: which message goes is decided by what their images have in common.

Similarity is that of ORB features (Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011): the
share of one image's features that match one of the other's, each being the other's nearest. The released code has a
random number in this place, and the wording of the paper's formula was not at hand: the formula is ours. The rule
around it is the same as in the policy `orbbuf`, which compares recorded motion.
"""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bufgym.model.buffer import ACCEPT, Buffer, has_space
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.scenario import Episode
from bufgym.utils.libraries import library
from bufgym_papers.perception.frames import Image, Sequence

FEATURES: Final = 500  # Features of an image at most, as OpenCV has it by default
NEAR_BITS: Final = 64
"""Descriptors of 256 bits match where at most so many differ (ORB-SLAM2's TH_LOW is 50, its TH_HIGH 100)."""


class OrbSimilarity:
    """Similarity of the images of two frames; features are computed once a frame and pairs compared once."""

    def __init__(self, image: Callable[[int], Image]) -> None:
        """``image(k)`` is the picture of frame k, uint8[height, width]."""
        cv2 = library("cv2", "bufgym-papers[perception]")
        self._image = image
        self._detector = cv2.ORB_create(FEATURES)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._descriptors: dict[int, NDArray[np.uint8]] = {}
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, i: int, j: int) -> float:
        """In [0, 1]; the same whichever comes first. An image without features is like no other."""
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


def orbbuf_by(similar: Callable[[int, int], float], episode: Episode) -> Policy:
    """`orbbuf` for one episode, by a similarity of two frames that are given by their places in it."""
    frames = {int(time_us): k for k, time_us in enumerate(episode.arrivals["arrival_us"].tolist())}

    def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
        L = len(buffer.slots)
        if has_space(buffer, arrival):
            return ACCEPT
        # The head's older neighbour is the message that left last; while none has left, the head stays.
        queue = [frames[int(buffer.dequeued_arrival_us)], *(int(seq) for seq in buffer.slots["seq"])]
        victim, most_similar = L - 1, -np.inf
        for k in range(0 if buffer.dequeued > 0 and L > 2 else 1, L - 1):
            if (similarity := similar(queue[k], queue[k + 2])) > most_similar:
                victim, most_similar = k, similarity
        return victim

    about = "ORBBuf by what two images have in common; it sees the images, as no other policy does."
    source = "ORBBuf [wang2021orbbuf], ORB features by OpenCV"
    return Policy("orbbuf-images", on_arrival, about=about, source=source, built_in=True)


COMPARED: Final = 3  # Further images that the last of so many decisions compares


def decision_ms(sequence: Sequence, decisions: int) -> NDArray[np.float64]:
    """float64[decisions]: times of one decision as the paper has it, ms.

    A message went and one came: the features of the new image are computed, and the similarity of each neighbour of
    the gap to the one now beside it. Reading the images takes no part.
    """
    images = [sequence.grey(k) for k in range(decisions + COMPARED)]
    similar = OrbSimilarity(images.__getitem__)
    for k in range(COMPARED - 1):
        similar(k, k + 1)
    times = np.zeros(decisions)
    for k in range(decisions):
        start_ns = time.perf_counter_ns()
        similar(k, k + 2)
        similar(k + 1, k + COMPARED)
        times[k] = (time.perf_counter_ns() - start_ns) / 1e6
    return times
