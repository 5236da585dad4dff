#!/usr/bin/env python3
"""A retargeting node: receives skeleton and poses and calls a function for each pose.

    pip install "../..[bus]"
    python retarget_node.py --csv poses.csv

As a program it writes one line per pose: capture time, state, declared latency, the pelvis in the world
(metres), and a quaternion x, y, z, w for each joint: world_from_pelvis, then parent_from_joint.
To drive a character, call `receive` with your own function.
"""

import argparse
import csv
import queue
import sys

from bundlemocap import Error, bus

# Seconds without a message before that is said.
PATIENCE = 5


def rotations(skeleton, pose):
    """Quaternion x, y, z, w of each joint by name: world_from_root, else parent_from_joint."""
    numbers = [*pose.root_rotation, *pose.local_rotations]
    return {
        name: tuple(numbers[4 * joint : 4 * joint + 4])
        for joint, name in enumerate(skeleton.joint_names)
    }


def receive(session, handle, stage="stage", actor="actor", poses=None):
    """Calls `handle(skeleton, pose)` on this thread for each pose, at most `poses` times. Poses before
    the first skeleton are skipped."""
    inbox = queue.Queue()
    topics = f"mocap/{stage}/actor/{actor}"
    subscribers = [
        bus.subscribe_state(session, f"{topics}/skeleton", bus.Skeleton, inbox.put),
        bus.subscribe_stream(session, f"{topics}/pose", bus.Pose, inbox.put),
    ]
    skeleton, is_said = None, False
    while poses is None or poses > 0:
        try:
            message = inbox.get(timeout=None if skeleton or is_said else PATIENCE)
        except queue.Empty:
            is_said = True
            print(f"nothing on {topics}/skeleton and pose yet; check --stage and --actor", file=sys.stderr)
            continue
        if isinstance(message, bus.Skeleton):
            skeleton = message
        elif skeleton is not None:
            handle(skeleton, message)
            poses = None if poses is None else poses - 1
    for subscriber in subscribers:
        subscriber.undeclare()


class CsvWriter:
    """Writes one CSV line per pose."""

    def __init__(self, file):
        self._file, self._writer, self._names = file, csv.writer(file), None

    def __call__(self, skeleton, pose):
        if self._names is None:
            self._names = list(skeleton.joint_names)
            columns = [f"{name}.{axis}" for name in self._names for axis in "xyzw"]
            head = ["capture_time_ns", "state", "latency_ms", "root_x", "root_y", "root_z"]
            self._writer.writerow(head + columns)
        latency_ms = (pose.due_time_ns - pose.capture_time_ns) * 1e-6
        by_name = rotations(skeleton, pose)
        line = [pose.capture_time_ns, bus.state_of(pose), f"{latency_ms:.3f}"]
        line += [f"{number:.6f}" for number in pose.root_position_m]
        line += [f"{number:.6f}" for name in self._names for number in by_name[name]]
        self._writer.writerow(line)
        self._file.flush()


def main():
    parser = argparse.ArgumentParser(description="Writes poses as CSV.")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="address of the node")
    parser.add_argument("--csv", help="output file; default: standard output")
    parser.add_argument("--stage", default="stage", help="name of the capture volume")
    parser.add_argument("--actor", default="actor", help="name of the performer")
    parser.add_argument("--poses", type=int, help="stop after this many poses")
    args = parser.parse_args()
    file = open(args.csv, "w", newline="") if args.csv else sys.stdout
    with file, bus.open_session(args.connect) as session:
        receive(session, CsvWriter(file), args.stage, args.actor, args.poses)


if __name__ == "__main__":
    try:
        main()
    except (KeyboardInterrupt, BrokenPipeError):
        pass
    except Error as error:
        raise SystemExit(str(error)) from None
