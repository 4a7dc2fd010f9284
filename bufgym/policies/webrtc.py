"""WebRTC's frame dropper, a leaky bucket in front of the encoder (modules/video_coding/utility/frame_dropper.cc).

Each frame that is kept fills the bucket with its bits. In each frame time the bucket leaks as much as the target bit
rate allows. While it holds more than half a second of that rate, a filtered share of the frames is dropped, evenly. An
unusually large frame fills the bucket bit by bit over half a second of frames.

WebRTC's target comes from the receiver's feedback. A robot's queue has no feedback: its target is the rate at which the
socket drains (``fragments.ahead_of_newcomer``), and nothing is dropped until that is known. With a target of 0 WebRTC
pauses the encoder, so every frame is dropped. These messages have no key frames: each counts as a delta frame.
"""

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.policies.classic import keep_first
from bufgym.policies.fragments import PIPE, RATE, UNKNOWN, account, ahead_of_newcomer
from bufgym.policies.registry import Arrival, Memory, built_in

BUCKET_S = 0.5  # Size of the bucket, s of the target rate: above it frames are dropped
MOST_S = 3.0  # Most seconds of the target rate in the bucket
MOST_DROPS_S = 4.0  # Longest run of dropped frames, s
LARGE = 3.0  # A frame larger than the average by this factor is large
SIZE_ALPHA, RATIO_ALPHA, FAST_RATIO_ALPHA = 0.9, 0.9, 0.8
"""Old value's share that the filters keep: of frame size, of drop ratio, and of that while the bucket runs far over."""
MOST_RATIO = 0.96
FORGETS_S = 1e6  # Time for which an old target holds until a message has shown another

STATE = ("level_bytes", "target", "average_bytes", "ratio", "count", "large_left", "large_part", "above")
LEVEL, TARGET, AVERAGE, RATIO, COUNT, LARGE_LEFT, LARGE_PART, ABOVE = range(len(PIPE), len(PIPE) + len(STATE))
"""Indices of the dropper's state, after the pipe's."""


@kernel
def retarget(memory: Memory, target: float) -> None:
    """Set a new target, bytes/us; a bucket over its new size shrinks along with it."""
    if target < memory[TARGET] and memory[LEVEL] > 1e6 * BUCKET_S * target:
        memory[LEVEL] *= target / memory[TARGET]
    memory[TARGET] = target
    memory[LEVEL] = min(memory[LEVEL], 1e6 * MOST_S * target)


@kernel
def leak(memory: Memory, period_us: float) -> None:
    """Pass one frame time: the bucket leaks, and the drop ratio follows its level."""
    drained = memory[TARGET] * period_us
    if memory[LARGE_LEFT] > 0:
        drained -= memory[LARGE_PART]
        memory[LARGE_LEFT] -= 1
    memory[LEVEL] = max(0.0, memory[LEVEL] - drained)
    size = 1e6 * BUCKET_S * memory[TARGET]
    alpha = FAST_RATIO_ALPHA if memory[LEVEL] > 1.3 * size else RATIO_ALPHA
    above = 1.0 if memory[LEVEL] > size else 0.0
    if above > memory[ABOVE]:
        memory[COUNT] = 0.0
    memory[RATIO] = min(MOST_RATIO, alpha * memory[RATIO] + (1 - alpha) * above)
    memory[ABOVE] = 1.0 if memory[LEVEL] >= size else 0.0


@kernel
def drops_frame(memory: Memory, period_us: float) -> bool:
    """Whether to drop this frame: a ratio of 1/2 or more drops several for each frame kept."""
    ratio = memory[RATIO]
    if ratio >= 0.5:
        most = int(1e6 * MOST_DROPS_S / period_us)
        limit = min(int(1 / max(1 - ratio, 1e-5) - 1 + 0.5), most)
        count = abs(memory[COUNT])
        memory[COUNT] = count + 1 if count < limit else 0.0
        return bool(count < limit)
    limit = int(1 / max(ratio, 1e-5) - 1 + 0.5)
    count = abs(memory[COUNT])
    if ratio == 0 or count >= limit:
        memory[COUNT] = 0.0
        return False
    memory[COUNT] = -count - 1
    return bool(count == 0)


@kernel
def fill(memory: Memory, size_bytes: float, period_us: float) -> None:
    """Add a kept frame's bytes to the bucket; a large frame goes in by equal parts over the next half second."""
    average = memory[AVERAGE]
    if average > 0 and size_bytes > LARGE * average and memory[LARGE_LEFT] == 0:
        memory[LARGE_LEFT] = int(max(0.5e6 / period_us, 5.0) + 0.5)
        memory[LARGE_PART] = size_bytes / memory[LARGE_LEFT]
        return
    memory[AVERAGE] = SIZE_ALPHA * average + (1 - SIZE_ALPHA) * size_bytes if average > 0 else size_bytes
    memory[LEVEL] = min(memory[LEVEL] + size_bytes, 1e6 * MOST_S * memory[TARGET])


@built_in(
    "webrtc-frame-dropper",
    memory=PIPE | dict.fromkeys(STATE, 0.0),
    source="WebRTC, modules/video_coding/utility/frame_dropper [webrtc]",
    reads_left=True,
)
def webrtc_frame_dropper(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """WebRTC's frame dropper: a leaky bucket at the socket's own rate; a full queue drops the newcomer."""
    ahead_bytes, period_us = ahead_of_newcomer(buffer, memory, FORGETS_S), max(1.0, buffer.period_us)
    decision = keep_first(buffer, arrival)
    if memory[RATE] < UNKNOWN:
        retarget(memory, memory[RATE])
        leak(memory, period_us)
        if memory[TARGET] == 0 or drops_frame(memory, period_us):
            decision = REJECT
        elif decision == ACCEPT:
            fill(memory, float(arrival.size_bytes), period_us)
    kept_bytes = float(arrival.size_bytes) if decision == ACCEPT else 0.0
    account(buffer, memory, ahead_bytes + kept_bytes, kept_bytes)
    return decision
