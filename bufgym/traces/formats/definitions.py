"""Types of messages: their names, the definitions that recordings bring along, and how messages are encoded."""

import functools
import re
from dataclasses import dataclass
from typing import Any, Final

from bufgym.traces.formats.faults import StrPath, fault

TF_TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_DDS_NAME: Final = re.compile(r"(\w+)::(\w+)::(?:dds_::)?(\w+?)_?")  # nav_msgs::msg::dds_::Odometry_
_MOST_DEFINED: Final = 2**20  # Characters of a definition that is compared; a longer one is no definition of ROS
# First two bytes of a message in a form of CDR; those of plain CDR are 0 and 1 (OMG, DDS-XTypes 1.3, table 60).
_OTHER_FORMS: Final = {
    **dict.fromkeys((2, 3), "a parameter list of XCDR1"),
    **dict.fromkeys((6, 7), "XCDR2"),
    **dict.fromkeys((8, 9), "XCDR2, delimited"),
    **dict.fromkeys((10, 11), "a parameter list of XCDR2"),
}


@dataclass(frozen=True)
class BagTopic:
    """What the messages of one topic are."""

    topic: str  # its name
    type: str  # the ROS message type, such as "nav_msgs/msg/Odometry"; the schema's name elsewhere
    encoding: str  # "cdr", "ros1" or what the MCAP file says
    definition: str = ""  # of the type, as the recording has it; empty where it has none
    language: str = ""  # of the definition: "ros2msg", "ros2idl", ...
    number: int = 0  # of the channel or connection: a topic may have several
    publisher: str = ""  # name of the node that sends on it; empty where the recording does not say


def ros_type(name: str) -> str:
    """A type's name as in ROS 2: also of ROS 1 ("nav_msgs/Odometry") and DDS; any other name unchanged."""
    if (match := _DDS_NAME.fullmatch(name)) is not None:
        return "/".join(match.groups())
    package, _, last = name.partition("/")
    return f"{package}/msg/{last}" if last and "/" not in last else name


def is_plain_cdr(data: bytes) -> bool:
    """Whether a message says that it is in CDR of the form that ROS 2 writes."""
    return data[:2] in (b"\0\0", b"\0\1")


def check_form(path: StrPath, place: str, data: bytes) -> None:
    """Refuse a message in a newer form of CDR, whose fields lie elsewhere."""
    form = _OTHER_FORMS.get(data[1]) if len(data) > 1 and data[0] == 0 else None
    if form is not None:
        raise fault(path, f"{place} is encoded in {form} (encapsulation 0x{data[1]:04x}): must be CDR (0x0000, 0x0001)")


def check_definition(path: StrPath, channel: BagTopic) -> None:
    """Refuse a topic whose recording defines its type otherwise than ROS does, by the first field that differs."""
    known = typestore(channel.encoding).fielddefs
    for name, defined in _parsed(channel.definition, channel.language, channel.type).items():
        own, must = _fields(defined), _fields(known[name]) if name in known else []
        if not own or not must or own == must:  # recorders also write a comment, or nothing
            continue
        k = next(k for k in range(max(len(own), len(must))) if own[k : k + 1] != must[k : k + 1])
        has, wants = ("nothing" if k >= len(fields) else " ".join(fields[k]) for fields in (own, must))
        rule = f"field {k + 1} of {name} is {has} in the recording: must be {wants}, as in ROS"
        raise fault(path, f"{channel.topic} carries another definition of {channel.type}: {rule}")


def _fields(definition: Any) -> list[tuple[str, str]]:
    """Type and name of each field."""
    return [(_named(kind), name) for name, kind in definition[1]]


def _named(kind: Any) -> str:
    """A field's type in words: "float64", "geometry_msgs/msg/Pose", "float64[36]"."""
    node, content = int(kind[0]), kind[1]
    if node in (3, 4):  # an array, a sequence
        return f"{_named(content[0])}[{content[1] or ''}]"
    return str(content if node == 2 else content[0])


@functools.lru_cache(maxsize=64)
def _parsed(definition: str, language: str, type: str) -> dict[str, Any]:
    """The types that a text defines; empty where it is none or cannot be parsed."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if not definition.strip() or len(definition) > _MOST_DEFINED:
        return {}
    try:
        if language == "ros2idl":
            return dict(get_types_from_idl(definition))
        return dict(get_types_from_msg(definition, type))
    except Exception:
        # Recorders also write other things there. What cannot be compared is judged by its messages.
        return {}


@functools.cache
def typestore(encoding: str) -> Any:
    """The types of ROS 2 (``cdr``) or ROS 1 (``ros1``), with those of tf in both."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY if encoding == "cdr" else Stores.ROS1_NOETIC)
    for name in TF_TYPES:
        if name not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store
