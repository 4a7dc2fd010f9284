"""Messages of ROS for tests: objects of any type, in which all is zero that a test does not give."""

from typing import Any

import numpy as np


def made(store: Any, type: str, /, **fields: Any) -> Any:
    """An object of a type in this store; fields that are not given are zero, and quaternions turn nothing."""
    if type == "geometry_msgs/msg/Quaternion":
        fields.setdefault("w", 1.0)
    for name, (kind, what) in store.fielddefs[type][1]:
        if name in fields:
            continue
        if kind.name == "BASE":
            fields[name] = "" if what[0] == "string" else 0.0 if "float" in what[0] else 0
        elif kind.name == "NAME":
            fields[name] = made(store, what)
        else:
            is_number = what[0][0].name == "BASE" and what[0][1][0] != "string"
            fields[name] = np.zeros(what[1] if kind.name == "ARRAY" else 0, what[0][1][0]) if is_number else []
    return store.types[type](**fields)
