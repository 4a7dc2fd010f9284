"""Asks services of a node or a container, for test_ros2_node.py; its last line is the answer. Needs rclpy.

change NODE TRANSITION...                     the state after each: 1 unconfigured, 2 inactive, 3 active, 4 finalized
load CONTAINER PACKAGE PLUGIN NAME:=VALUE...  the node's name and number, or why not
unload CONTAINER NUMBER
"""

import sys
from typing import Any

import rclpy
import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.parameter import Parameter

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}


def main(command: str, name: str, *words: str) -> str:
    rclpy.init()
    node = rclpy.create_node("asks")

    def call(kind: Any, service: str, request: Any) -> Any:
        client = node.create_client(kind, f"{name}/{service}")
        assert client.wait_for_service(60), f"{name}/{service} is not there"
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=60)
        return future.result()

    if command == "change":
        states = []
        for word in words:
            state = call(GetState, "get_state", GetState.Request()).current_state.id
            shutdown = {1: Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, 2: Transition.TRANSITION_INACTIVE_SHUTDOWN}
            to = Transition(id=shutdown[state] if word == "shutdown" else TRANSITIONS[word])
            assert call(ChangeState, "change_state", ChangeState.Request(transition=to)).success, word
            states.append(call(GetState, "get_state", GetState.Request()).current_state.id)
        return " ".join(map(str, states))
    from composition_interfaces.srv import LoadNode, UnloadNode

    if command == "unload":
        answer = call(UnloadNode, "_container/unload_node", UnloadNode.Request(unique_id=int(words[0])))
        return "unloaded" if answer.success else f"refused: {answer.error_message}"
    package, plugin, *given = words
    named = [word.split(":=", 1) for word in given]
    parameters = [Parameter(key, value=yaml.safe_load(value)).to_parameter_msg() for key, value in named]
    request = LoadNode.Request(package_name=package, plugin_name=plugin, parameters=parameters)
    answer = call(LoadNode, "_container/load_node", request)
    return f"{answer.full_node_name} {answer.unique_id}" if answer.success else f"refused: {answer.error_message}"


if __name__ == "__main__":
    print(main(*sys.argv[1:]))
